"""Data sets of your own: folders of panoramas or photos with labels."""
