"""The geometry that artifacts, stages and reports share: arrays in, arrays out."""
