"""Reading what comes from outside: photographs, films, meshes, models, arrays and texts.

Nothing that a file says of itself is believed before it is checked against the bytes that are
there. `files` opens and bounds; what knows a format stands beside it. `SECURITY.md` says what is
promised.
"""
