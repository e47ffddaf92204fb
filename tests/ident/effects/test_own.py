"""Effects of one's own: what is accepted as one, and how installed packages are found."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, cast

import numpy as np
import pytest

import ident
from ident.arrays import FloatArray
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import PlacedEffect, check_settings, columns_at, effect_key, fits_data
from ident.effects.own import (
    SHIPPED,
    families_of,
    installed_families,
    installed_version,
    is_of_package,
    known_effect,
    package_of,
    search_families,
)
from ident.effects.rotor import known_rotors
from ident.effects.signals import Signals

SAMPLES = 5
AXES = 2


@dataclass(frozen=True, slots=True)
class SquareDrag(ident.Effect):
    """τ = c q̇ |q̇|^η."""

    name = "square-drag"
    declares = ident.Property.ODD_IN_VELOCITY
    abscissa = ident.Abscissa.VELOCITY
    coefficients = (ident.Column("drag", "Nm/(rad/s)^2", least=0.0),)

    exponent: Annotated[float, ident.Range(0.5, 3.0)] = 1.0

    def columns(self, signals: ident.Signals, axis: int) -> FloatArray:
        """Columns, shape (1, k)."""
        velocity_rad_s = signals.velocity_rad_s[axis]
        return np.asarray(velocity_rad_s * np.abs(velocity_rad_s) ** self.exponent)[None]


@dataclass(frozen=True, slots=True)
class Named(SquareDrag):
    """The same with another name."""

    name = "Square Drag"


@dataclass(frozen=True, slots=True)
class Spring(SquareDrag):
    """The same with a name of the dictionary."""

    name = "spring"


@dataclass(frozen=True, slots=True)
class SecondDrag(SquareDrag):
    """Another class with the same name."""


@dataclass(frozen=True, slots=True)
class Rotor(SquareDrag):
    """A rotor's form without its settings."""

    name = "rotor-drag"
    has_rotor_form = True


@dataclass(frozen=True, slots=True)
class OneWave(SquareDrag):
    """An amplitude of one coefficient."""

    name = "wave-drag"
    reported = ident.Reported.AMPLITUDE


@dataclass(frozen=True, slots=True)
class Unranged(SquareDrag):
    """A field that no calibration would keep."""

    name = "unranged-drag"
    scale: float = 1.0


@dataclass(frozen=True, slots=True)
class Colon(SquareDrag):
    """A coefficient that would be taken for one of a payload."""

    name = "colon-drag"
    coefficients = (ident.Column("drag:disc", "Nm"),)


@dataclass(frozen=True, slots=True)
class Lonely(SquareDrag):
    """On two joints, without saying on which."""

    name = "lonely-drag"
    side = ident.GearSide.TWO_JOINTS


@dataclass(frozen=True, slots=True)
class Twice(SquareDrag):
    """Two coefficients of one name."""

    name = "twice-drag"
    coefficients = (ident.Column("drag", "Nm"), ident.Column("drag", "Nm"))  # type: ignore[assignment]


@dataclass(frozen=True, slots=True)
class Misspelled(SquareDrag):
    """A setting to refine that there is not."""

    name = "misspelled-drag"
    refined = ("exponents",)


@pytest.mark.parametrize(
    ("effects", "words"),
    [
        (
            SquareDrag(),
            r"SquareDrag\(exponent=1.0\); expected a list of effects; put brackets "
            r"around it",
        ),
        (None, r"None; expected a list of effects"),
        (
            [SquareDrag(7.0)],
            r"exponent = 7 in effect 'square-drag'; expected a value "
            r"from 0.5 to 3",
        ),
        ([SquareDrag(float("nan"))], r"exponent = nan in effect 'square-drag'; expected a value"),
        (
            [SquareDrag(1)],
            r"exponent = 1 in effect 'square-drag'; expected a value of type "
            r"float.*write float\(1\)",
        ),
        (
            [Lonely()],
            r"effect 'lonely-drag' on two joints without a setting `other_axis`; expected "
            r"the number",
        ),
        (
            [SHIPPED["spring"]],
            r"drivegain's own effect 'spring'; expected others: it is tried "
            r"without this",
        ),
        (
            [Twice()],
            r"coefficients \['drag', 'drag'\] of effect 'twice-drag'; expected a "
            r"name for each",
        ),
        (
            [Misspelled()],
            r"exponents in `refined` of effect 'misspelled-drag'; expected names "
            r"among its .*: exponent",
        ),
        (
            [Rotor()],
            r"rotor_inertia_kg_m2, with_rotor in `has_rotor_form` of effect 'rotor-drag'; "
            r"expected names",
        ),
        (
            [OneWave()],
            r"1 coefficients of effect 'wave-drag', which reports give as one amplitude; "
            r"expected two",
        ),
        ([SquareDrag], r"the class SquareDrag; expected objects of subclasses of `ident.Effect`"),
        (["spring"], r"'spring'; expected objects"),
        ([Named()], r"the name 'Square Drag'; expected lowercase words joined by hyphens"),
        ([Spring()], r"the name 'spring', which drivegain has; give it another"),
        ([SquareDrag(), SecondDrag()], r"two classes of effects with the name 'square-drag'"),
        (
            [Unranged()],
            r"fields of effect 'unranged-drag' without a range: scale; expected each as "
            r"`Annotated",
        ),
        (
            [Colon()],
            r"coefficients \['drag:disc'\] of effect 'colon-drag'; expected at least one, "
            r"with a name",
        ),
    ],
)
def test_what_is_no_usable_effect_is_refused(effects: Any, words: str) -> None:
    with pytest.raises(ident.EffectRefused, match=rf"^`own_effects`: found .*{words}"):
        families_of(effects, "`own_effects`")


def test_settings_of_numpy_are_numbers_of_python() -> None:
    """As from `numpy.linspace`; a calibration writes and reads them as any other."""
    effects = [SquareDrag(np.float64(2.0))]
    ((effect, *_),) = families_of(effects, "`own_effects`")
    assert effect == SquareDrag(2.0)
    assert type(effect.settings["exponent"]) is float
    exponent = np.float32(2.0)
    ((single,),) = families_of([SquareDrag(exponent)], "`own_effects`")  # type: ignore[arg-type]
    assert type(single.settings["exponent"]) is float
    driver = np.int64(3)
    ((whole,),) = families_of([Declaring(driver=driver)], "`own_effects`")  # type: ignore[arg-type]
    assert type(whole.settings["driver"]) is int
    whole_exponent = SquareDrag(np.int64(2))  # type: ignore[arg-type]
    with pytest.raises(ident.EffectRefused, match="expected a value of type float"):
        families_of([whole_exponent], "`own_effects`")


def test_effects_of_one_name_are_one_family() -> None:
    drags = (SquareDrag(1.0), SquareDrag(2.0))
    assert families_of(drags, "here") == (drags,)
    assert search_families(drags) == (*EFFECTS, drags)
    assert search_families() == EFFECTS


@pytest.mark.slow
def test_an_effect_of_no_package_is_named_by_its_module() -> None:
    assert package_of(SquareDrag()) == f"module {__name__}"
    effect = EFFECTS[0][0]
    assert package_of(effect) is None


@dataclass(frozen=True, slots=True)
class Given(SquareDrag):
    """Columns that a test gives."""

    name = "given"
    given: Annotated[int, ident.Range(0, 3)] = 0

    def columns(self, signals: ident.Signals, axis: int) -> FloatArray:
        """Columns of another shape, with a number that is not finite, complex, or right ones."""
        del signals, axis
        if self.given == 0:
            return np.zeros(SAMPLES)
        if self.given == 1:
            return np.array([[0.0, 1.0, np.nan, 0.0, 0.0]])
        if self.given == 3:
            return cast(FloatArray, 1j * np.ones((1, SAMPLES)))
        return cast(FloatArray, [[1] * SAMPLES])


def test_columns_of_an_effect_of_ones_own_are_checked() -> None:
    current_a = np.zeros((AXES, SAMPLES))
    time_s = np.zeros(SAMPLES)
    stub = SimpleNamespace(current_a=current_a, time_s=time_s)
    signals = cast(Signals, stub)
    effect = Given(given=0)
    with pytest.raises(
        ident.EffectRefused,
        match=r"'given': found columns of shape \(5,\); "
        r"expected \(1, 5\)",
    ):
        columns_at(effect, signals, 0)
    given_effect = Given(given=1)
    with pytest.raises(
        ident.EffectRefused,
        match=r"'given': found columns with numbers that are "
        r"not finite",
    ):
        columns_at(given_effect, signals, 0)
    columns = columns_at(Given(given=2), signals, 0)
    assert np.array_equal(columns, np.ones((1, SAMPLES)))
    with pytest.raises(
        ident.EffectRefused,
        match=r"`columns` of effect 'given' returns is of complex numbers .*; expected real ones",
    ):
        columns_at(Given(given=3), signals, 0)


@dataclass(frozen=True, slots=True)
class Failing(SquareDrag):
    """One whose method fails."""

    name = "failing"

    error: Annotated[int, ident.Range(0, 1)] = 0

    def columns(self, signals: ident.Signals, axis: int) -> FloatArray:
        """Fail."""
        raise (KeyError("no such signal"), SystemExit(0))[self.error]


@pytest.mark.parametrize(("error", "words"), [(0, "KeyError .*no such signal"), (1, "SystemExit")])
def test_an_effect_of_ones_own_that_fails_is_refused_by_name(error: int, words: str) -> None:
    current_a = np.zeros((AXES, SAMPLES))
    time_s = np.zeros(SAMPLES)
    stub = SimpleNamespace(current_a=current_a, time_s=time_s)
    effect = Failing(error=error)
    signals = cast(Signals, stub)
    with pytest.raises(ident.EffectRefused, match=rf"effect 'failing': found {words}"):
        columns_at(effect, signals, 0)


@dataclass(frozen=True, slots=True)
class Hesitating(SquareDrag):
    """One that cannot say whether the data show it."""

    name = "hesitating"

    def fits_in(self, runs: Sequence[Signals], axis: int) -> bool:
        """Fail."""
        raise IndexError(f"{len(runs)} runs, axis {axis}")


def test_an_effect_that_cannot_say_whether_it_fits_is_refused_by_name() -> None:
    assert fits_data(SquareDrag(), (), 0)
    with pytest.raises(
        ident.EffectRefused,
        match=r"'hesitating': found IndexError \(0 runs, axis 1\) in its "
        r".*fits_in",
    ):
        fits_data(Hesitating(), (), 1)


class Site:
    """A folder on the path, into which packages with entry points are written."""

    def __init__(self, folder: Path) -> None:
        """Store the folder."""
        self.folder = folder

    def install(self, package: str, code: str, effects: str = "EFFECTS") -> None:
        """Write module and metadata of a package; without names of effects it registers none."""
        module = package.replace("-", "_")
        (self.folder / f"{module}.py").write_text(code, encoding="utf-8")
        metadata = self.folder / f"{module}-0.3.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {package}\nVersion: 0.3\n", encoding="utf-8"
        )
        if effects:
            (metadata / "entry_points.txt").write_text(
                f"[drivegain.effects]\ndrag = {module}:{effects}\n", encoding="utf-8"
            )


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.syspath_prepend(tmp_path)
    installed_families.cache_clear()
    yield Site(tmp_path)
    installed_families.cache_clear()


def _code(package: str) -> str:
    """A module with the drag, as a class of its own."""
    return (
        f"from {SquareDrag.__module__} import SquareDrag\n\n"
        f"class Drag(SquareDrag):\n    '''Of {package}.'''\n\n"
        "EFFECTS = [Drag(1.0), Drag(2.0)]\nONE = Drag()\n"
    )


def test_an_installed_package_is_searched_and_named(site: Site) -> None:
    site.install("drag-one", _code("drag-one"))
    *shipped, family = search_families()
    assert tuple(shipped) == EFFECTS
    expected = [{"exponent": 1.0}, {"exponent": 2.0}]
    assert [effect.settings for effect in family] == expected
    assert package_of(family[0]) == "drag-one 0.3"
    assert type(known_effect("square-drag")) is type(family[0])


def test_an_entry_point_may_name_one_effect(site: Site) -> None:
    site.install("drag-single", _code("drag-single"), "ONE")
    (family,) = search_families()[len(EFFECTS) :]
    assert len(family) == 1


@pytest.mark.slow
def test_an_argument_takes_the_place_of_an_installed_effect(site: Site) -> None:
    site.install("drag-argued", _code("drag-argued"))
    own = SquareDrag(1.5)
    expected = (*EFFECTS, (own,))
    assert search_families((own,)) == expected
    assert known_effect("square-drag", (own,)) is own
    assert package_of(own) == f"module {__name__}"


def test_two_packages_with_one_effect_are_refused(site: Site) -> None:
    site.install("drag-first", _code("drag-first"))
    site.install("drag-second", _code("drag-second"))
    with pytest.raises(
        ident.EffectRefused,
        match=r"package 'drag-second 0.3': found effect 'square-drag', which package 'drag-first "
        r"0.3' has, too",
    ):
        search_families()


@pytest.mark.parametrize(
    ("package", "code", "words"),
    [
        (
            "drag-alone",
            "import nothing_of_this_name",
            r"cannot be loaded \(ModuleNotFoundError: No "
            r"module named",
        ),
        ("drag-raising", "raise KeyError('x')", r"cannot be loaded \(KeyError: 'x'\)"),
        (
            "drag-empty",
            "WRONG = 1",
            r"cannot be loaded \(AttributeError: module 'drag_empty' has "
            r"no attribute",
        ),
        ("drag-exiting", "raise SystemExit(0)", r"cannot be loaded \(SystemExit: 0\)"),
        (
            "drag-number",
            "EFFECTS = 3",
            r"found 3; expected objects of subclasses of "
            r"`ident.Effect`",
        ),
    ],
)
def test_a_broken_package_stops_a_search_and_no_prediction(
    site: Site, package: str, code: str, words: str
) -> None:
    site.install(package, code)
    with pytest.raises(
        ident.EffectRefused,
        match=rf"^entry point 'drag' of package '{package} "
        rf"0.3': .*{words}",
    ):
        search_families()
    spring = known_effect("spring")
    assert spring is not None
    assert spring.name == "spring"
    with pytest.raises(ident.EffectRefused, match=package):
        known_effect("square-drag")


def test_a_package_that_is_not_there_is_named() -> None:
    error = ident.EffectNotInstalled("square-drag", "J2", "drag-one 0.3")
    assert (error.effect, error.axis, error.package) == ("square-drag", "J2", "drag-one 0.3")
    assert "install this package" in str(error)
    of_module = ident.EffectNotInstalled("square-drag", "J2", "module drags")
    # The functions that predict have no such argument: whoever reads the calibration gives it.
    assert of_module.remedy.endswith("`load_calibration(path, own_effects=[...])`")


def test_an_effect_of_the_package_that_a_calibration_names_is_used_in_any_version(
    site: Site,
) -> None:
    site.install("drag-one", _code("drag-one"))
    known = known_effect("square-drag")
    assert known is not None
    assert is_of_package(known, "drag-one 0.1")
    assert is_of_package(known, "module drag_one")
    assert not is_of_package(known, "drag-other 0.3")
    assert not is_of_package(known, "module drags")


def test_an_effect_of_the_same_name_of_another_package_is_not_used(site: Site) -> None:
    site.install("drag-foreign", _code("drag-foreign"))
    known = known_effect("square-drag")
    assert known is not None
    error = ident.EffectNotInstalled(
        "square-drag", "J2", "drag-one 0.2", other=package_of(known) or ""
    )
    assert "found an effect of this name of drag-foreign 0.3" in str(error)
    assert "expected drag-one 0.2" in str(error)
    assert "own_effects" in str(error)


def test_a_package_that_does_not_register_its_effect_is_not_to_be_installed(site: Site) -> None:
    site.install("drag-hidden", _code("drag-hidden"), "")
    assert known_effect("square-drag") is None
    assert installed_version("drag-hidden 0.2") == "0.3"
    assert installed_version("drag-missing 0.2") == ""
    assert installed_version("module drags") == ""
    error = ident.EffectNotInstalled("square-drag", "J2", "drag-hidden 0.2", installed="0.3")
    assert "found version 0.3 of its package, which does not register it" in str(error)
    assert "entry points of the group drivegain.effects" in str(error)
    assert "install this package" not in str(error)
    assert error.state == "not registered"
    missing = ident.EffectNotInstalled("square-drag", "J2", "drag-hidden 0.2")
    assert missing.state == "not installed"


def test_settings_of_an_effect_of_ones_own_are_those_with_a_range() -> None:
    effect = SquareDrag(2.0)
    assert effect.settings == {"exponent": 2.0}
    assert effect.with_settings({"exponent": 0.7}) == replace(effect, exponent=0.7)


NAMES_OF_THE_DICTIONARY = (
    *(
        "lower",
        "upper",
        "sense",
        "other_axis",
        "order",
        "exponent",
        "with_rotor",
        "rotor_inertia_kg_m2",
    ),
    *(
        "held",
        "sags",
        "two_terms",
        "backwards",
        "half_gap_rad",
        "resonant_rad_nm",
        "damping_ratio",
        "filter_s",
    ),
)
"""Names that settings of the dictionary have, where they mean something."""


@dataclass(frozen=True, slots=True)
class Borrowed(SquareDrag):
    """One whose settings have names of the dictionary's, and which declares nothing."""

    name = "borrowed-names"
    coefficients = (ident.Column("cosine", "Nm"), ident.Column("sine", "Nm"))  # type: ignore[assignment]

    lower: Annotated[float, ident.Range(0.0, 9.0)] = 3.0
    upper: Annotated[float, ident.Range(0.0, 9.0)] = 1.0
    sense: Annotated[int, ident.Range(-1, 1)] = 0
    other_axis: Annotated[int, ident.Range(0, 9)] = 9
    order: Annotated[float, ident.Range(0.0, 9.0)] = 2.5
    with_rotor: Annotated[int, ident.Range(0, 1)] = 1
    rotor_inertia_kg_m2: Annotated[float, ident.Range(0.0, 9.0)] = 0.4
    held: Annotated[int, ident.Range(0, 1)] = 0
    sags: Annotated[int, ident.Range(0, 1)] = 0
    two_terms: Annotated[int, ident.Range(0, 1)] = 1
    backwards: Annotated[int, ident.Range(0, 1)] = 1
    half_gap_rad: Annotated[float, ident.Range(0.0, 9.0)] = 0.0
    resonant_rad_nm: Annotated[float, ident.Range(0.0, 9.0)] = 0.0
    damping_ratio: Annotated[float, ident.Range(0.0, 9.0)] = 0.0
    filter_s: Annotated[float, ident.Range(0.0, 9.0)] = 0.0


BORROWED = Borrowed()


def test_settings_with_names_of_the_dictionary_mean_nothing() -> None:
    assert set(NAMES_OF_THE_DICTIONARY) == set(BORROWED.settings)
    families_of([BORROWED], "here")
    check_settings(BORROWED, BORROWED.settings, 0, AXES)
    assert BORROWED.second_axis is None
    assert not BORROWED.has_rotor_form
    assert not BORROWED.fits_rotor
    assert BORROWED.form_settings == BORROWED.added_settings == ()
    assert BORROWED.nearly_declared == {}
    placed = PlacedEffect(BORROWED, 0)
    assert placed.name_among(("J1", "J2")) == "borrowed-names on J1"
    assert known_rotors([placed], AXES) == ()
    (column, _) = placed.columns
    missing = [name for name in NAMES_OF_THE_DICTIONARY if f"{name} " not in column.name]
    assert missing == []  # a value of zero is one like any other


def test_two_effects_of_one_axis_differ_in_whole_numbers_alone() -> None:
    effect = replace(BORROWED, order=3.0, lower=4.0)
    assert effect_key(BORROWED, 0) == effect_key(effect, 0)
    for name in ("sense", "with_rotor", "held", "two_terms", "backwards"):
        settings = {name: 1 - int(BORROWED.settings[name])}
        other = BORROWED.with_settings(settings)
        assert effect_key(BORROWED, 0) != effect_key(other, 0), name


@dataclass(frozen=True, slots=True)
class Declaring(SquareDrag):
    """One that declares what its settings mean."""

    name = "declaring-drag"
    axis_setting = "driver"
    form_settings = ("form",)
    added_settings = ("form",)
    key_settings = ("exponent",)

    driver: Annotated[int, ident.Range(1, 9)] = 2
    form: Annotated[int, ident.Range(0, 1)] = 0

    @property
    def settings_fault(self) -> str:
        """An exponent of one in the second form."""
        if self.form and self.exponent == 1.0:
            return "exponent = 1 in its second form; expected another"
        return ""


def test_a_meaning_that_a_class_declares_is_used() -> None:
    effect = Declaring()
    families_of([effect], "here")
    assert effect.second_axis == 2
    assert PlacedEffect(effect, 0).name_among(("J1", "J2")) == "declaring-drag on J1 with J2"
    (column,) = PlacedEffect(effect, 0).columns
    assert "form" not in column.name
    assert effect_key(effect, 0) == effect_key(effect.with_settings({"form": 1}), 0)
    assert effect_key(effect, 0) != effect_key(effect.with_settings({"exponent": 2.0}), 0)
    with pytest.raises(
        ident.EffectRefused,
        match=r"on axis 2 is given driver = 2; it is the "
        r"number of another of",
    ):
        check_settings(effect, effect.settings, 1, AXES)
    settings = {**effect.settings, "form": 1}
    with pytest.raises(
        ident.EffectRefused,
        match=r"'declaring-drag' is given exponent = 1 in its "
        r"second form",
    ):
        check_settings(effect, settings, 0, AXES)
