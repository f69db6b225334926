"""YAML files of other tools: read as plain data, and handed to the one that they belong to."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from certbound.problem.foreign.keys import Restated
from certbound.problem.foreign.lucid import from_lucid
from certbound.problem.foreign.stochastic_barrier import from_stochastic_barrier

_DELTA = "delta -> not in such files: 0.001, unless --delta (`delta=`) says otherwise"


def restate(text: str, name: str) -> Restated:
    """The problem of a YAML file of LUCID or StochasticBarrier.jl.

    What is not understood, stands twice or belongs to neither is a ValueError that names the key.
    """
    table = _plain(text)
    if "system_flag" in table:
        tool, found = "StochasticBarrier.jl", from_stochastic_barrier(table)
    elif any(key in table for key in ("system_dynamics", "X_bounds", "X_init", "X_unsafe")):
        tool, found = "LUCID", from_lucid(table)
    else:
        raise ValueError(
            f"{name!r} must be a file of LUCID (with `system_dynamics`) or of StochasticBarrier.jl (with "
            f"`system_flag`), got the keys {', '.join(map(str, table)) or 'none'}; state your own problem in TOML."
        )
    told = (f"{name} is a file of {tool}:", *found.notes, _DELTA)
    return Restated(content={"name": name, **found.content}, notes=told)


def _plain(text: str) -> Mapping[Any, Any]:
    import yaml

    try:
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            if isinstance(event, yaml.AliasEvent):
                raise ValueError(f"the file must not repeat parts by reference, got *{event.anchor}; write them out.")
        _check_keys(yaml.compose(text, Loader=yaml.SafeLoader))
        table = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(f"the problem file is not YAML: {' '.join(str(error).split())}.") from error
    except RecursionError as error:
        raise ValueError("the problem file is nested too deeply.") from error
    if not isinstance(table, Mapping):
        raise ValueError(f"the problem file must be a table of keys, got {type(table).__name__}.")
    return table


def _check_keys(node: Any) -> None:
    """Refuse a key that stands twice, of which YAML would take the last."""
    if isinstance(getattr(node, "value", None), list):
        pairs = [entry for entry in node.value if isinstance(entry, tuple)]
        keys = Counter(key.value for key, _ in pairs if isinstance(key.value, str))
        for key, count in keys.items():
            if count > 1:
                raise ValueError(f"`{key}` must stand once, it stands {count} times.")
        for entry in node.value:
            _check_keys(entry[1] if isinstance(entry, tuple) else entry)
