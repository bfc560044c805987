"""Three wide photographs of teeth: the teeth themselves are the landmarks.

Where photographs are 40 to 50 degrees apart, no feature matches. But every photograph shows the
same row of crowns: find the teeth (`photo`), their crowns and landmarks, say which tooth is which
and where the cameras are with a textbook arch as prior (`arch`), then a dense surface (`surface`).
"""
