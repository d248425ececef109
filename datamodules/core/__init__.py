"""What all data sets share: data modules, samples, transforms, the prepared store, checks."""
