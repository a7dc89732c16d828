"""Docstrings of the fields of a class, read from its source, for help and documents."""

import ast
import inspect
from contextlib import suppress
from itertools import pairwise


def meanings(of: type) -> dict[str, str]:
    """Docstring of each field, in one line."""
    docstrings: dict[str, str] = {}
    for each in reversed(of.__mro__):
        with suppress(TypeError, OSError):  # a class without Python source
            (definition,) = ast.parse(inspect.getsource(each)).body
            assert isinstance(definition, ast.ClassDef)
            docstrings |= {
                ast.unparse(key.target): " ".join(ast.literal_eval(text.value).split())
                for key, text in pairwise(definition.body)
                if isinstance(key, ast.AnnAssign) and isinstance(text, ast.Expr)
            }
    return docstrings
