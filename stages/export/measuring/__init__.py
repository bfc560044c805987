"""Overjet, overbite, midlines and arch widths from numbered crowns, each with how sure it is."""
