"""Live sessions on real or emulated devices."""
