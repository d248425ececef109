"""Reading untrusted files: checkpoints, exported networks, the settings of runs.

Files are plain data. Tensors and plain values are read, settings are compared with those that files
may have (`tangent_train.registry`), and are not interpreted again.
"""
