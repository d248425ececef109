"""Read untrusted files: checkpoints, exported networks, settings of runs.

Files are plain data: tensors and plain values. Settings are checked against those that files may
give (`tangent_train.config.build`), and are not interpreted again.
"""
