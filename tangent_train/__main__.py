"""``python -m tangent_train``: print the commands."""

from tangent_train.cli.main import overview

if __name__ == "__main__":
    overview()
