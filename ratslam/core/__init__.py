"""The seam between sessions and SLAM methods: types, protocols, packing of records, the session."""
