"""register.html: what moved, in a table, in colours, and both scenes live under a slider."""
