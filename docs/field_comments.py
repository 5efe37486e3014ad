"""For griffe, with which mkdocstrings reads the code: what a field is, in a comment behind it, is its docstring."""

from __future__ import annotations

import re
from typing import Any

from griffe import Attribute, Docstring, Extension


class FieldComments(Extension):
    """Fields of a class with a comment, such as `distance: float  # of the eye [m]`."""

    def on_attribute_instance(self, *, attr: Attribute, **_: Any) -> None:
        """Called for each attribute that is read."""
        found = re.search(r"  # (.+)", attr.source) if attr.parent is not None and attr.parent.is_class else None
        if attr.docstring is None and found is not None:
            attr.docstring = Docstring(found[1], parent=attr)
