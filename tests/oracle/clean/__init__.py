"""The semantics of `ratslam/README.md`, step by step, without OpenRatSLAM's quirks."""
