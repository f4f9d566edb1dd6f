"""The public names and their signatures; a change of any is made in api_surface.json too.

`python tests/system/test_api_surface.py` writes the file anew.
"""

import importlib
import inspect
import json
import re
from pathlib import Path

SURFACE = Path(__file__).with_name("api_surface.json")
MODULES = ("invrender", "invrender.data", "invrender.render", "invrender.render.torch")
MOST = 14  # top-level names


def signature(thing):
    """Without addresses, and without the back end's types."""
    return re.sub(r"<(function|class) .*?(at 0x\w+|')>", "...", str(inspect.signature(thing)))


def signatures(name, thing):
    """{name: signature} of a function, or of a class's constructor and public methods."""
    if inspect.ismodule(thing):
        thing = thing.__call__
    if not callable(thing):
        return {name: "data"}
    if not inspect.isclass(thing):
        return {name: signature(thing)}
    if issubclass(thing, Exception):
        return {name: "exception"}
    found = {name: signature(thing)}
    for method, value in inspect.getmembers(thing):
        if not method.startswith("_") and (inspect.isfunction(value) or inspect.ismethod(value)):
            found[f"{name}.{method}"] = signature(value)
        elif not method.startswith("_") and isinstance(value, property):
            found[f"{name}.{method}"] = "property"
    if "__call__" in vars(thing):
        found[f"{name}.__call__"] = signature(thing.__call__)
    return found


def surface():
    found = {}
    for name in MODULES:
        module = importlib.import_module(name)
        for public in getattr(module, "__all__", ["Renderer"]):
            found |= signatures(f"{name}.{public}", getattr(module, public))
    return found


def test_surface_is_as_recorded():
    recorded = json.loads(SURFACE.read_text())
    found = surface()
    assert recorded.keys() - found.keys() == set(), "public names are gone"
    assert found == recorded


def test_few_names_all_documented():
    import invrender

    assert len(invrender.__all__) <= MOST
    for name in invrender.__all__:
        thing = getattr(invrender, name)
        assert thing.__doc__ and len(thing.__doc__.split()) > 5, name


if __name__ == "__main__":
    SURFACE.write_text(json.dumps(surface(), indent=1) + "\n")
