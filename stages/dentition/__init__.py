"""Not a stage: crowns in photographs, which `teeth` reads and `init` numbers.

`crowns`: outlines, order, landmarks; `tooth_rows`: which numbers a row may have; `corrections`:
what a person puts right; `overlay`: photographs with outlines and numbers.
"""
