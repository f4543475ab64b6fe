"""The decorators of compiled loops, which `dem` has too, and the word that the first run on a machine says of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from dem.compiled import inlined, loop, unfused

__all__ = ["inlined", "loop", "tell_first_compilation", "unfused"]


def tell_first_compilation(say: Callable[[str], None]) -> None:
    """Call ``say``, once, when numba compiles a loop of this program because it has no machine code for it on disk."""
    from numba.core import event

    class First(event.Listener):
        told = False

        def on_start(self, event: Any) -> None:
            if not self.told:
                self.told = True
                say("compiling loops for this processor: some seconds, once")

        def on_end(self, event: Any) -> None:
            pass

    event.register("numba:compile", First())
