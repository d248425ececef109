"""Settings: building objects, rules, manifests of output folders."""
