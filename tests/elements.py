"""Elements of a page without a browser, which a test uses in place of a person."""

import asyncio
from typing import Any
from unittest import mock

import numpy as np


class Handle:
    """Element of a browser, which the test uses in place of a person."""

    def __init__(self, value: Any = None) -> None:
        self.value, self.uses = value, list[Any]()
        self.visible, self.content, self.label = True, "", ""
        self.min, self.max = -np.inf, np.inf

    def on_click(self, act: Any) -> Any:
        self.uses.append(act)
        return act

    on_update = on_click

    def use(self, value: Any = None) -> None:
        self.value = value
        for act in self.uses:
            done = act(mock.Mock(client=1))
            if done is not None:
                asyncio.run(done)

    def __enter__(self) -> "Handle":
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing to leave."""

    def close(self) -> None:
        """Nothing to close."""


class Gui:
    """Elements by their labels, of viser's methods `add_...`."""

    def __init__(self) -> None:
        self.elements: dict[str, Handle] = {}

    def __getattr__(self, _: str) -> Any:
        def add(label: str, *given: Any, **__: Any) -> Handle:
            handle = self.elements[label] = Handle()
            if len(given) == 4:  # of a slider
                handle.min, handle.max, _, handle.value = given
            return handle

        return add
