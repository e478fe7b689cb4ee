"""Offscreen pictures of a MuJoCo scene, with one OpenGL context a camera that can be closed beside others."""

import atexit
import ctypes
import ctypes.util
import os
import sys
import weakref
from typing import Any

import mujoco
import numpy as np

_INSTALL = (
    "On Debian or Ubuntu: apt-get install libegl1 libgl1-mesa-dri (for MUJOCO_GL=egl), or apt-get install libosmesa6 "
    "(for MUJOCO_GL=osmesa)"
)

_live: "weakref.WeakSet[OffscreenCamera]" = weakref.WeakSet()


class OffscreenCamera:
    """Renders one of a model's cameras into an array, without a window.

    The library's own ``mujoco.Renderer`` frees OpenGL objects on whatever context is current, which spoils the
    pictures of other renderers. Here the camera's own context is made current before everything.

    :param model: the scene
    :param camera: name of a camera in it
    :param width: of the picture, in pixels
    :param height: of the picture, in pixels
    :param shadows: whether to draw shadows, which takes several times as long
    :raises RuntimeError: if this machine has no OpenGL that works without a display
    """

    def __init__(self, model: mujoco.MjModel, camera: str, width: int, height: int, shadows: bool = False):
        self._model = model
        self._context: mujoco.MjrContext | None = None
        self._gl = _make_gl_context(width, height)
        self._gl.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        if not _live:
            # After the context, whose own clean-up at exit must come later than this.
            atexit.unregister(_close_all)
            atexit.register(_close_all)
        _live.add(self)
        mujoco.mjr_resizeOffscreen(width, height, self._context)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=100)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._options = mujoco.MjvOption()
        self._view = mujoco.MjvCamera()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._view.fixedcamid = model.camera(camera).id
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        self._flipped = np.empty((height, width, 3), dtype=np.uint8)

    def render(self, data: mujoco.MjData) -> np.ndarray:
        """A picture of the scene's present state.

        :param data: with positions of geoms, cameras and lights up to date
        :return: uint8, shape ``[height, width, 3]``, a copy
        :raises RuntimeError: after :meth:`close`
        """
        if self._context is None:
            raise RuntimeError("this camera is closed: make the environment anew")
        self._gl.make_current()
        mujoco.mjv_updateScene(
            self._model, data, self._options, None, self._view, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene
        )
        mujoco.mjr_render(self._viewport, self._scene, self._context)
        mujoco.mjr_readPixels(self._flipped, None, self._viewport, self._context)
        return self._flipped[::-1].copy()

    def close(self) -> None:
        """Free the OpenGL objects and their context; once is enough."""
        if self._context is None:
            return
        self._gl.make_current()
        self._context.free()
        self._context = None
        self._gl.free()
        _live.discard(self)

    def __del__(self) -> None:
        # __init__ may have failed before there was a context to free.
        if getattr(self, "_context", None) is not None:
            self.close()


def _close_all() -> None:
    for camera in list(_live):
        camera.close()


def _make_gl_context(width: int, height: int) -> Any:
    backend = os.environ.get("MUJOCO_GL", "").lower().strip()
    if backend in ("disable", "disabled", "off", "false", "0"):
        raise RuntimeError(
            f"MUJOCO_GL={backend} switches rendering off, and this environment observes pictures: unset it, or set it "
            f"to egl or osmesa. {_INSTALL}"
        )
    headless = sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    if headless and backend not in ("egl", "osmesa"):
        backend = _headless_backend()
        # mujoco's C library reads it when it loads OpenGL.
        os.environ["MUJOCO_GL"] = backend
    try:
        if backend == "egl":
            from mujoco.egl import GLContext
        elif backend == "osmesa":
            from mujoco.osmesa import GLContext
        else:
            from mujoco import GLContext
        return GLContext(width, height)
    except Exception as error:  # whatever the OpenGL bindings raise, it means that there is no OpenGL
        raise RuntimeError(_failure(backend or "OpenGL", error)) from error


def _headless_backend() -> str:
    """The first of egl and osmesa whose library this machine has."""
    for backend, libraries in {"egl": ("libEGL.so.1",), "osmesa": ("libOSMesa.so.8", "libOSMesa.so.6")}.items():
        for library in libraries:
            try:
                ctypes.CDLL(library)
            except OSError:
                continue
            return backend
    raise RuntimeError(
        "this environment observes pictures, and this machine has no display and neither libEGL nor libOSMesa to "
        f"render without one. {_INSTALL}"
    )


def _failure(backend: str, error: Exception) -> str:
    return (
        f"rendering with {backend} does not work on this machine ({type(error).__name__}: {error}). On a machine without "
        f"a display set MUJOCO_GL to egl or osmesa. {_INSTALL}"
    )
