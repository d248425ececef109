"""Data sets as Lightning data modules, a module or folder each.

A data set lists the files of its splits and decodes them; `core` has the base classes. The config
``data/<name>.yaml`` names its class, and nothing else knows it.
"""
