"""Cityscapes (Cordts et al. 2016)."""
