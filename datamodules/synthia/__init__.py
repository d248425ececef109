"""SYNTHIA and OmniSYNTHIA."""
