"""Effects of one's own: found by an entry point of other packages, or given as an argument.

They are subclasses of `Effect`. A package registers its effects in its `pyproject.toml`::

    [project.entry-points."drivegain.effects"]
    eccentric-friction = "my_effects:EFFECTS"

where ``EFFECTS`` is an effect, or a sequence of effects: those of one name are one family, with the
values of its searched parameters that a search tries.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cache
from importlib.metadata import (
    EntryPoint,
    PackageNotFoundError,
    entry_points,
    packages_distributions,
    version,
)

import numpy as np

from ident.effects.dictionary import EFFECTS, GEOMETRY, UNNAMED, Family
from ident.effects.effect import Effect, GearSide, Reported, is_shipped, setting_kind, setting_range
from ident.errors import EffectRefused

ENTRY_POINT_GROUP = "drivegain.effects"
ROTOR_SETTINGS = ("rotor_inertia_kg_m2", "with_rotor")  #: Of an effect with a rotor's form
_NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")

_FIRST_MEMBERS = [family[0] for family in (*EFFECTS, *GEOMETRY)]
SHIPPED = {effect.name: effect for effect in (*_FIRST_MEMBERS, *UNNAMED)}
"""One member of each family of the dictionary, by its name."""


@dataclass(frozen=True, slots=True)
class InstalledFamily:
    """A family of another package."""

    family: Family
    package: str  #: name and version of the package


def search_families(own_effects: Sequence[Effect] = ()) -> tuple[Family, ...]:
    """Return the families that a search tries: shipped, installed and one's own.

    Args:
        own_effects: given as an argument; they take the place of installed ones of the same name.

    Raises:
        EffectRefused: an effect of another package cannot be used (`installed_families`,
            `families_of`).
    """
    given = families_of(own_effects, "`own_effects`")
    given_names = {family[0].name for family in given}
    installed: list[Family] = []
    for name, family_of_package in installed_families().items():
        if name not in given_names:
            installed.append(family_of_package.family)
    return (*EFFECTS, *installed, *given)


def known_effect(name: str, own_effects: Sequence[Effect] = ()) -> Effect | None:
    """Return a member of the family of this name; None where there is none.

    Args:
        name: of the family.
        own_effects: given as an argument; they come before installed ones of the same name.

    Raises:
        EffectRefused: an effect of another package cannot be used.
    """
    if name in SHIPPED:  # a package that cannot be loaded is no reason not to predict without it
        return SHIPPED[name]
    for effect in own_effects:
        if effect.name == name:
            return effect
    installed = installed_families().get(name)
    if installed is None:
        return None
    return installed.family[0]


def known_names() -> tuple[str, ...]:
    """Return the names of all families: of the dictionary, then of installed packages."""
    return (*SHIPPED, *installed_families())


@cache  # of one process: a package that is installed later is found by the next one
def installed_families() -> dict[str, InstalledFamily]:
    """Return the families that installed packages register by an entry point, by their names.

    Raises:
        EffectRefused: an entry point cannot be loaded, is no effect, or two packages have effects
            of one name.
    """
    found: dict[str, InstalledFamily] = {}
    points = entry_points(group=ENTRY_POINT_GROUP)
    for point in sorted(points, key=lambda one: (one.name, one.value)):
        package = _package_of_entry(point)
        where = f"entry point {point.name!r} of package {package!r}"
        for family in families_of(_loaded(point, where), where):
            name = family[0].name
            if name in found:
                other = found[name].package
                raise EffectRefused(
                    f"{where}: found effect {name!r}, which package {other!r} has, too; expected "
                    "one package for each effect; remove one of the packages"
                )
            found[name] = InstalledFamily(family, package)
    return found


def families_of(effects: Iterable[object], where: str) -> tuple[Family, ...]:
    """Group effects of one's own by name, and check that a search and a calibration can use them.

    Args:
        effects: in the order in which the search tries them.
        where: source of the effects, for the error.

    Raises:
        EffectRefused: one is not an effect, has a name that cannot be used, or a field that no
            calibration would keep.
    """
    if isinstance(effects, Effect) or not isinstance(effects, Iterable):
        raise EffectRefused(
            f"{where}: found {effects!r:.80}; expected a list of effects; put brackets around it"
        )
    families: dict[str, list[Effect]] = {}
    for effect in effects:
        if not isinstance(effect, Effect):
            if isinstance(effect, type):
                given = f"the class {effect.__name__}"
            else:
                given = f"{effect!r:.80}"
            raise EffectRefused(
                f"{where}: found {given}; expected objects of subclasses of `ident.Effect`"
            )
        plain = _with_plain_settings(effect)
        _check(plain, where)
        family = families.setdefault(plain.name, [])
        if family and type(family[0]) is not type(plain):
            raise EffectRefused(
                f"{where}: found two classes of effects with the name {plain.name!r}; expected "
                "one name for each class"
            )
        family.append(plain)
    return tuple(map(tuple, families.values()))


def package_of(effect: Effect) -> str | None:
    """Return name and version of the package that has an effect; None of one that drivegain ships.

    An effect that no installed package has is named by its module: `module my_effects`.
    """
    if is_shipped(effect):
        return None
    installed = installed_families().get(effect.name)
    if installed is not None and type(installed.family[0]) is type(effect):
        return installed.package
    module = type(effect).__module__
    packages = packages_distributions().get(module.partition(".")[0], ())
    for package in packages:
        return f"{package} {version(package)}"
    return f"module {module}"


def is_of_package(effect: Effect, package: str) -> bool:
    """Whether an effect is of the package that a calibration names, in whichever version.

    Args:
        effect: of one's own.
        package: as from `package_of`, when the calibration was made: an effect of a module may
            have moved into a package since, and a package may be imported without its entry point.
    """
    module = f"module {type(effect).__module__}"
    own = package_of(effect) or ""
    return package == module or _name_of(own) == _name_of(package)


def installed_version(package: str) -> str:
    """Return the installed version of the package that a calibration names; empty without one."""
    if package.startswith("module "):
        return ""
    try:
        return version(_name_of(package))
    except PackageNotFoundError:
        return ""


def _name_of(package: str) -> str:
    """Name of a package without its version; a module with its word."""
    if package.startswith("module "):
        return package
    return package.partition(" ")[0]


def _package_of_entry(point: EntryPoint) -> str:
    if point.dist is None:
        return point.module
    return f"{point.dist.name} {point.dist.version}"


def _loaded(point: EntryPoint, where: str) -> Iterable[object]:
    """What an entry point names: one effect, or several."""
    try:
        loaded = point.load()
    # Code of others: it may fail in any way, and even end the program.
    except (Exception, SystemExit) as error:
        found = f"{point.value!r} that cannot be loaded ({type(error).__name__}: {error})"
        raise EffectRefused(
            f"{where}: found {found}; expected an effect; repair or remove the package"
        ) from error
    if isinstance(loaded, list | tuple):
        return loaded
    return (loaded,)


def _with_plain_settings(effect: Effect) -> Effect:
    """Return an effect with settings of numpy as Python's numbers, as a calibration has them."""
    plain: dict[str, float] = {}
    for setting, value in effect.settings.items():
        if isinstance(value, np.floating | np.integer):
            plain[setting] = value.item()
    if not plain:
        return effect
    return effect.with_settings(plain)


def _check(effect: Effect, where: str) -> None:
    """Refuse an effect that has the name of another, or that a calibration could not name again."""
    name = effect.name
    if not _NAME.fullmatch(name):  # names of parameters begin with it
        raise EffectRefused(
            f"{where}: found an effect with the name {name!r}; expected lowercase words joined by "
            "hyphens, such as 'eccentric-friction'"
        )
    if name in SHIPPED and not is_shipped(effect):
        raise EffectRefused(
            f"{where}: found an effect with the name {name!r}, which drivegain has; give it another"
        )
    if name in SHIPPED:
        raise EffectRefused(
            f"{where}: found drivegain's own effect {name!r}; expected others: it is tried "
            "without this"
        )
    kept = set(effect.settings)
    lost = [field.name for field in fields(effect) if field.name not in kept]
    if lost:
        lost_names = ", ".join(lost)
        raise EffectRefused(
            f"{where}: found fields of effect {name!r} without a range: {lost_names}; "
            "expected each as `Annotated[float, ident.Range(least, largest)]`: a calibration keeps "
            "these alone"
        )
    axis_setting = effect.axis_setting
    if effect.side is GearSide.TWO_JOINTS and axis_setting not in kept:
        raise EffectRefused(
            f"{where}: found effect {name!r} on two joints without a setting "
            f"`{axis_setting}`; expected the number of the second one: "
            f"`{axis_setting}: Annotated[int, ident.Range(0, 12)] = 0`"
        )
    _check_properties(effect, where)
    _check_settings(effect, where)
    _check_coefficients(effect, where)


def _check_settings(effect: Effect, where: str) -> None:
    """Refuse an effect with a setting of another type than annotated, or outside its range."""
    name = effect.name
    for setting, value in effect.settings.items():
        kind = setting_kind(effect, setting)
        kind_name = kind.__name__
        if type(value) is not kind:
            raise EffectRefused(
                f"{where}: found {setting} = {value!r} in effect {name!r}; expected a value of "
                f"type {kind_name}, as it is annotated; write {kind_name}({value!r})"
            )
        allowed = setting_range(effect, setting)
        if not allowed.least <= value <= allowed.largest:
            expected = f"a value from {allowed.least:g} to {allowed.largest:g}"
            raise EffectRefused(
                f"{where}: found {setting} = {value:g} in effect {name!r}; expected {expected}, "
                "as its range says; correct one of both"
            )


def _check_coefficients(effect: Effect, where: str) -> None:
    """Refuse an effect without coefficients, or with names that a parameter cannot have."""
    coefficients = [column.name for column in effect.coefficients]
    found = f"{where}: found coefficients {coefficients} of effect {effect.name!r}"
    if len(set(coefficients)) < len(coefficients):
        raise EffectRefused(f"{found}; expected a name for each")
    is_unfit = any(":" in name or not name for name in coefficients)
    if is_unfit or not coefficients:
        raise EffectRefused(f"{found}; expected at least one, with a name without a colon")


def _check_properties(effect: Effect, where: str) -> None:
    """Refuse an effect whose properties name settings that it does not have."""
    axis_settings: tuple[str, ...] = ()
    if effect.axis_setting:
        axis_settings = (effect.axis_setting,)
    rotor_settings: tuple[str, ...] = ()
    if effect.has_rotor_form:
        rotor_settings = ROTOR_SETTINGS
    named = {
        "refined": effect.refined_once_chosen,
        "axis_setting": axis_settings,
        "form_settings": effect.form_settings,
        "key_settings": effect.key_settings,
        "added_settings": effect.added_settings,
        "nearly_declared": tuple(effect.nearly_declared),
        "has_rotor_form": rotor_settings,
    }
    settings = sorted(effect.settings)
    expected = ", ".join(settings) or "it has none"
    for given, names in named.items():
        unknown = ", ".join(sorted(set(names) - set(settings)))
        if unknown:
            raise EffectRefused(
                f"{where}: found {unknown} in `{given}` of effect {effect.name!r}; "
                f"expected names among its settings: {expected}"
            )
    coefficient_count = len(effect.coefficients)
    if effect.reported is Reported.AMPLITUDE and coefficient_count != 2:
        raise EffectRefused(
            f"{where}: found {coefficient_count} coefficients of effect {effect.name!r}, "
            "which reports give as one amplitude; expected two, of a cosine and a sine; leave "
            "`reported` out"
        )
