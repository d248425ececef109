"""SynPASS (Zhang et al. 2022)."""
