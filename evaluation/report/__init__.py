"""The report: one page that shows runs to a person."""
