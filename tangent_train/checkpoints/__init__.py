"""Reading untrusted files: checkpoints, exported networks, the settings of runs.

Files are plain data. Tensors and plain values are read, settings are compared with what files may
say (`tangent_train.registry`), and nothing in them is interpreted again.
"""
