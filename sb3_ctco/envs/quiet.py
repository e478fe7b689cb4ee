"""What MuJoCo says of models that its users cannot change."""

import warnings


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
    if "'settotalmass' is deprecated" not in message:
        warnings.warn(message, stacklevel=2)
