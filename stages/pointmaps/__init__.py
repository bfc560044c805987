"""Pointmaps from learned models that the user has installed, or from files.

`predict`: the entry; `options`, `interface`: what it is asked and what a model answers; one module
per model; `files`: pointmaps made elsewhere; `prepare`: images as a model wants them and maps back
in the pixels of the view; `graph`: which pairs; `memory`: whether they fit; `quick_start`: first
cameras and points. Nothing here downloads anything.
"""
