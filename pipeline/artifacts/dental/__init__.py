"""Teeth by number, and what a person says of those that were found."""
