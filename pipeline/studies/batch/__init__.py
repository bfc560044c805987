"""Many cases with one command: find them, run each in a process of its own, say what came of all.

`find` and `listing` say what the cases are, `records` what is known of each, `task` and `child` run
one, `cluster` finds the machines, `running` does all of it, `summary` writes the tables.
"""
