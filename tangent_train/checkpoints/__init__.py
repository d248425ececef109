"""Read untrusted files: checkpoints and exported networks.

Files are plain data: tensors and plain values. Settings are checked against those that files may
give (`tangent_train.config.from_file`), and are not interpreted again.
"""
