"""Hypotheses about which tooth is which: made, solved, scored, searched, edited."""
