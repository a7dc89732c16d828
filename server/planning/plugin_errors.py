"""Errors of a plug-in's code in flight: they are counted and reported, but end no flight."""

from traceback import format_exception

from skytether.server.planning.scheme import Tell


class PluginErrors:
    """Context manager for calls of a plug-in's code: an exception ends the block and is counted.

    The first error of each count is reported, with its traceback.

    Args:
        what: kind and name of the plug-in, for the report.
        then: consequence of its failure, for the report.
        count: name of the count.
    """

    def __init__(self, what: str, then: str, count: str, tell: Tell) -> None:
        self._what, self._then, self._count, self._tell = what, then, count, tell
        self._reported: set[str] = set()

    def __enter__(self) -> None:
        pass

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> bool:
        if isinstance(error, Exception):
            self.note(error)
        return isinstance(error, Exception)

    def note(self, error: Exception, count: str = "") -> None:
        """Count an error. Errors with their own `count` are reported without a traceback."""
        name, text = count or self._count, ""
        if name not in self._reported:
            self._reported.add(name)
            trace = "" if count else "".join(format_exception(error))
            text = f"{trace}{self._what}: {type(error).__name__}: {error}; {self._then}"
        self._tell(name, text)


NO_PLAN = "a vehicle for which it fails is sent no plan at that step"
