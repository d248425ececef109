"""Panoramas of Matterport3D (Chang et al. 2017)."""
