"""Common parts of all data sets: data modules, samples, transforms, the prepared store, checks."""
