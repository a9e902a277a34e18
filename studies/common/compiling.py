"""Seconds that JAX reports for compilation: steadier than differences of call times."""

import jax

_EVENTS = (
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
)


class Compiling:
    """Sum of the seconds of lowering and compilation since it was made; tracing is not counted."""

    def __init__(self) -> None:
        self.seconds = 0.0
        jax.monitoring.register_event_duration_secs_listener(self._hear)

    def _hear(self, event: str, seconds: float, **_: object) -> None:
        if event in _EVENTS:
            self.seconds += seconds

    def so_far(self) -> float:
        """Seconds since the last call, or since the beginning."""
        seconds, self.seconds = self.seconds, 0.0
        return seconds
