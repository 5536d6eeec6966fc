"""The report: one page that shows runs to a person."""

PAGE_START = rb"<!doctype html>\n[^\0]*? \xc2\xb7 ratslam report</title>"
"""Pattern of the beginning of a page."""
