"""The results of a transfer from photos to panoramas as tables and charts."""
