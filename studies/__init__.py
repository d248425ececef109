"""The paper's figures about distortion, one file per study, and what goes beyond them."""
