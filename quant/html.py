"""How pages for people are made: one look, one way to write numbers, nothing beside the page."""

from __future__ import annotations

from importlib import resources
from typing import Final

import jinja2

DASH: Final = "–"
"""Stands where nobody knows."""

LOOK: Final = __package__
"""Its templates hold what all pages share: `page.css` and `sortable.js`."""


def template(package: str, name: str) -> jinja2.Template:
    """A template of `package`; what it includes may be its own or one that all pages share."""
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([_folder(package), _folder(LOOK)]),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {"number": number, "difference": difference}
    return environment.get_template(name)


def number(value: float | None, digits: int) -> str:
    """A number with its thousands apart; a dash where nobody knows."""
    return DASH if value is None else f"{_rounded(value, digits):,.{digits}f}".replace("-", "−")


def difference(value: float | None, digits: int) -> str:
    """A number with its sign, ±0 where the digits show no other; a dash where nobody knows."""
    if value is None:
        return DASH
    seen = _rounded(value, digits)
    return ("+" if seen > 0 else "" if seen else "±") + number(value, digits)


def _rounded(value: float, digits: int) -> float:
    """Without the sign of a zero."""
    return round(value, digits) or 0.0


def _folder(package: str) -> jinja2.BaseLoader:
    """The templates of a package, installed in whatever way."""
    templates = resources.files(package) / "templates"

    def text(name: str) -> str | None:
        file = templates / name
        return file.read_text("utf-8") if file.is_file() else None

    return jinja2.FunctionLoader(text)
