"""What a raw confidence says of a depth or a point.

Raw confidences are at least 1, as pointmap models give them. At 1 nothing is known. Up to `FILLED`
a depth was filled in from what lies around it; up to `MEASURED` it is a guess with a reason (the
shape of crowns, one weak match); above, photographs agree on it.
"""

FILLED, MEASURED = 1.25, 1.5
