"""Acting and learning in separate processes, for machines that do not wait."""

from sb3_ctco.realtime.journal import JournalReader, JournalWriter
from sb3_ctco.realtime.learner import LearnerError
from sb3_ctco.realtime.trainer import AsynchronousTrainer

__all__ = ["AsynchronousTrainer", "JournalReader", "JournalWriter", "LearnerError"]
