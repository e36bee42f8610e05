"""Creation of Mitsuba's plugin objects where `mi.load_dict` must not be called."""

from __future__ import annotations

import mitsuba as mi


def made(kind: str, **values: object) -> mi.Object:
    """Plugin object of this kind with these parameters.

    `mi.load_dict` replaces the process's file resolver for a moment. Scenes load on several threads, and a thread that
    searches for a file in that moment reads freed memory.
    """
    props = mi.Properties(kind)
    for name, value in values.items():
        props[name] = value
    return mi.PluginManager.instance().create_object(props)
