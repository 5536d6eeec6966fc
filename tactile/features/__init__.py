"""From raw signals to contact features and whisker images."""
