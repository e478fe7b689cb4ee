"""Acting and learning in separate processes, for machines that do not wait."""

from sb3_ctco.realtime.journal import JournalError, JournalReader, JournalWriter, repair_journal
from sb3_ctco.realtime.learner import LearnerError, Transition
from sb3_ctco.realtime.trainer import AsynchronousTrainer

__all__ = [
    "AsynchronousTrainer",
    "JournalError",
    "JournalReader",
    "JournalWriter",
    "LearnerError",
    "Transition",
    "repair_journal",
]
