"""Data sets of your own: a folder of panoramas with labels."""
