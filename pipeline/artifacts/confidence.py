"""What a raw confidence says of a depth or a point.

Raw confidences are at least 1, as pointmap models give them. At 1 nothing is known. Up to
`COMPLETED` a depth goes on from what lies around it in the picture. Up to `FILLED` it is the shape
that crowns have, where one photograph alone shows them: mm off, not cm. Both fill: they are used
where nothing better is. Up to `MEASURED` it is a guess with a reason (crowns' shape under exact
cameras, one weak match); above, photographs agree on it.
"""

COMPLETED, FILLED, MEASURED = 1.2, 1.25, 1.5
