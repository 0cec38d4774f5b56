"""Signatures of public classes as Python sees them, and a check that a page documents every public name."""

import importlib
import inspect

from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util import logging
from sphinx.util.inspect import stringify_signature

PACKAGES = (
    "sb3_reinforce",
    "sb3_reinforce.diagnostics",
    "sb3_reinforce.diagnostics.plots",
    "sb3_reinforce.estimation",
    "sb3_reinforce.recurrent",
    "sb3_reinforce.zoo",
)
logger = logging.getLogger(__name__)


def check(_: Sphinx, env: BuildEnvironment) -> None:
    """Warn of each public object that no page documents by one of its names; ``-W`` makes an error of it."""
    documented = env.domains.python_domain.objects
    things = {
        f"{package}.{name}": getattr(module, name)
        for package, module in ((package, importlib.import_module(package)) for package in PACKAGES)
        for name in getattr(module, "__all__", ())
    }
    found = {id(thing) for name, thing in things.items() if name in documented}
    for name, thing in things.items():
        if id(thing) not in found:
            logger.warning("no page documents %s", name)


def signature_of(
    app: Sphinx, what: str, name: str, thing: object, options: object, signature: str, returned: str
) -> tuple[str, str] | None:
    """The arguments of ``__init__`` for a class with a ``__new__`` that only hands them on."""
    if what != "class" or not str(signature).startswith("(*args"):
        return None
    return stringify_signature(inspect.signature(thing), show_annotation=False), returned


def setup(app: Sphinx) -> dict[str, bool]:
    """Check once all pages are read."""
    app.connect("autodoc-process-signature", signature_of)
    app.connect("env-check-consistency", check)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
