"""What MuJoCo says of models that its users cannot change."""

import contextlib
import logging
import warnings
from collections.abc import Iterator

#: Of an attribute in models of Gymnasium and dm_control
_DEPRECATED = "'settotalmass' is deprecated"


@contextlib.contextmanager
def without_deprecations() -> Iterator[None]:
    """Keep to itself what is said of the attribute while dm_control, which logs it, makes an environment."""
    logger = logging.getLogger("absl")

    def is_wanted(record: logging.LogRecord) -> bool:
        return _DEPRECATED not in record.getMessage()

    logger.addFilter(is_wanted)
    try:
        yield
    finally:
        logger.removeFilter(is_wanted)


def mute_deprecated_attributes() -> None:
    """Drop the warning of a deprecated attribute in Gymnasium's own models; MuJoCo's other warnings become Python's.

    For processes that belong to this package, such as its commands: MuJoCo has one handler of warnings per process.
    """
    try:
        import mujoco
    except ImportError:
        return
    mujoco.set_mju_user_warning(_pass_on)


def _pass_on(message: str) -> None:
    if _DEPRECATED not in message:
        warnings.warn(message, stacklevel=2)
