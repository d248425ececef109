"""The paper's figures on distortion, one short script each: ``python -m studies.fov``."""
