"""Scenes of one file with several sets of values, between which cameras and an observer move."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError, parameter, sanitize

from .bands import is_nerg
from .moments import Moment, ShapeMover
from .scene_loading import check_scene, check_scene_file, list_scene_files, load_scene

_MOVABLE = frozenset(
    "to_world fov fov_axis focal_length near_clip far_clip principal_point_offset_x principal_point_offset_y "
    "aperture_radius focus_distance".split()
)
"""Properties of sensors that a loaded scene can take."""

_PARAMETERS = _MOVABLE | {"x_fov"}
"""The same as `mi.traverse` names them."""


class SceneSequence:
    """Loads a scene file with several sets of values of its `<default>`s, one after the other.

    Where only sensors move, or the observer of `nerg`, the loaded scene takes their properties: fields and shapes are
    not read again, and images of the scene are replayed. A scene is valid until the next one is loaded.

    Parameters
    ----------
    path
        Scene file, or a name of ``loaded`` for messages.
    values
        Values of all scenes.
    loaded
        A Mitsuba scene in memory, which is the only scene. None: the file is loaded.
    moment
        Where objects were; ``time`` among the values of a scene replaces its time. ``unknown_objects`` are those whose
        pose is unknown in the last scene.
    """

    def __init__(
        self, path: Path, values: Mapping[str, str] | None = None, loaded: Any = None, moment: Moment | None = None
    ):
        self.path, self.values = path, dict(values or {})
        self.has_file = loaded is None
        self._scene: Any = loaded
        self._nodes: Any = None
        self.moment, self.unknown_objects = moment, list[str]()
        self._mover: ShapeMover | None = None

    def list_files(self, frame: Mapping[str, str]) -> list[Path]:
        """Return the scene file and the files that it names with ``frame``; none for a scene in memory."""
        files = list_scene_files(self.path, self._split_time(frame)[0]) if self.has_file else []
        return files if self.moment is None else [*files, *self.moment.files]

    def load(self, frame: Mapping[str, str]) -> Any:
        """Return the Mitsuba scene with the values of ``frame``, too; errors as for `load_scene`."""
        values, time = self._split_time(frame)
        if self.has_file and (self._scene is None or not self._move_sensors(values)):
            # Before the next scene is read, the memory of the last one is free.
            self._scene = self._nodes = self._mover = None
            # Merged meshes would lose their names.
            self._scene = load_scene(self.path, values, merge=self.moment is None)
            self._nodes = self._parse(values).nodes
        if self.moment is not None:
            self._mover = self._mover or ShapeMover(self._scene)
            self.unknown_objects = self._mover.move(self.moment, time)
        return self._scene

    def _split_time(self, frame: Mapping[str, str]) -> tuple[dict[str, str], float]:
        """Return the values of `<default>`s, and the time of the moment, 0 without one. Raises `NergError`."""
        values = {**self.values, **frame}
        if self.moment is None:
            return values, 0.0
        time = values.pop("time", self.moment.time)
        try:
            return values, float(time)  # pyright: ignore[reportArgumentType]
        except (TypeError, ValueError) as error:
            got = "none" if time is None else f'"{sanitize(time, 40)}"'
            raise NergError(f"the time of objects must be seconds, got {got}; set {parameter('time')}") from error

    def _move_sensors(self, values: Mapping[str, str]) -> bool:
        """Give the loaded scene its sensors with ``values``; return False if other objects change, too."""
        import mitsuba as mi

        check_scene_file(self.path, values)
        integrator, sensors = self._scene.integrator(), list(self._scene.sensors())
        has_observer = is_nerg(integrator) and integrator.observer is not None
        sensors += [integrator.observer] if has_observer else []
        try:
            state = self._parse(values)
            indices = _list_sensors(state)
            changed = _list_changes(self._nodes, state.nodes)
            if changed is None or not changed.issubset(indices) or len(indices) != len(sensors):
                return False
            moved = self._load_sensors(values)
        except (NergError, RuntimeError):
            # Loading the whole scene raises the error again, in other words.
            return False
        # Without a scene until all of them are moved, so that an error leaves none that is moved in part.
        scene, self._scene = self._scene, None
        for index, old, new in zip(indices, sensors, moved):
            if index in changed:
                target, source = mi.traverse(old), mi.traverse(new)
                for name in _PARAMETERS.intersection(target.keys()):
                    target[name] = source[name]
                target.update()
        if has_observer:
            integrator.parameters_changed(["observer.to_world"])
        self._scene, self._nodes = scene, state.nodes
        return True

    def _load_sensors(self, values: Mapping[str, str]) -> list[Any]:
        """Load only the sensors of the file (`_list_sensors`)."""
        import mitsuba as mi

        parser: Any = mi.parser
        state = self._parse(values)
        indices, root = _list_sensors(state), state.root.props
        for name in list(root.keys()):
            del root[name]
        for index in indices:
            root[f"sensor{index}"] = mi.Properties.ResolvedReference(index)
        scene = parser.instantiate(parser.ParserConfig(mi.variant()), state)
        check_scene(self.path, scene)
        return scene.sensors()

    def _parse(self, values: Mapping[str, str]) -> Any:
        """Return the objects of the file as Mitsuba's parser lists them."""
        import mitsuba as mi

        parser: Any = mi.parser
        config = parser.ParserConfig(mi.variant())
        config.merge_meshes = config.merge_equivalent = False
        state = parser.parse_file(config, str(self.path), **values)
        parser.transform_all(config, state)
        return state


def _list_sensors(state: Any) -> list[int]:
    """Indices of the sensors of a parsed scene, followed by that of the observer of `nerg`."""
    import mitsuba as mi

    sensors, observers = list[int](), list[int]()
    for reference in map(state.root.props.__getitem__, state.root.props.keys()):
        if isinstance(reference, mi.Properties.ResolvedReference):
            node = state.nodes[reference.index()]
            if node.type == mi.ObjectType.Sensor:
                sensors.append(reference.index())
            elif node.props.plugin_name() == "nerg" and "observer" in node.props:
                observers.append(node.props["observer"].index())
    return sensors + observers


def _list_changes(old: Any, new: Any) -> set[int] | None:
    """Indices of nodes that differ in properties of `_MOVABLE`; None if others differ, too."""
    if len(old) != len(new):
        return None
    changed = {index for index, (first, second) in enumerate(zip(old, new)) if first != second}
    is_movable = all(_list_fixed(old[index]) == _list_fixed(new[index]) for index in changed)
    return changed if is_movable else None


def _list_fixed(node: Any) -> tuple[Any, ...]:
    """What cannot change of the object of a parsed ``node``."""
    import mitsuba as mi

    props = mi.Properties(node.props)
    for name in _MOVABLE.intersection(props.keys()):
        del props[name]
    return node.type, props.plugin_name(), props
