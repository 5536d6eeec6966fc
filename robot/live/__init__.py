"""A session on real devices, or on emulated ones."""
