"""An emulated head behind real libusb: umockdev stands in for the kernel. Needs no package but GObject's."""
