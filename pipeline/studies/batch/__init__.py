"""Many cases with one command: find them, run each in a process of its own, say what came of all.

`find` and `listing` say what the cases are, `sources` what each is computed from, `records` what
is known of it, `task` and `child` run one, `cluster` finds the machines, `running` does all of it,
`summary` writes the tables.
"""
