"""The tables of evaluation/RESULTS.md."""
