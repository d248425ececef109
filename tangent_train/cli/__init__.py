"""The commands: compose a config, build its objects, run them."""
