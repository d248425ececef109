"""Tasks: training and evaluation of a network and its head."""

from tangent_train.tasks.optimization import warmup_cosine
from tangent_train.tasks.task import PixelTask, ShapeTask, Task

__all__ = ["PixelTask", "ShapeTask", "Task", "warmup_cosine"]
