"""DensePASS (Ma et al. 2021)."""
