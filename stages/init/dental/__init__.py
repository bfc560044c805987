"""Three wide photographs of teeth: the teeth themselves are the landmarks.

Where photographs are 40 to 50 degrees apart, no feature matches. But every photograph shows the
same row of crowns, which the stage `teeth` has found: say which tooth is which (`numbering`) and
where the cameras are (`cameras`) with a textbook arch as prior, then make a dense surface
(`surface`).
"""
