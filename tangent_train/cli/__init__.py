"""Commands: compose a config, build its objects and run them."""
