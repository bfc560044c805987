"""From files of photographs and films to pixels: decoders, and the processes that they run in."""
