"""User-defined data sets: folders of panoramas or photos with labels."""
