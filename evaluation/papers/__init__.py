"""Figures of papers and tables of results; nothing else imports them."""
