"""Drivers of the whisker head, the UR-10 and the Create."""
