"""Tasks: training and evaluation of a network and its head."""

from tangent_train.tasks.base import Task
from tangent_train.tasks.pixels import PixelTask
from tangent_train.tasks.schedules import warmup_cosine
from tangent_train.tasks.shapes import ShapeTask

__all__ = ["PixelTask", "ShapeTask", "Task", "warmup_cosine"]
