"""A whole guided session, made once:
rigs whose recordings, fits and predictions are copies of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from daq.config.cell import Cell
from daq.jobs.block_check import BlockFacts
from daq.jobs.calibrate import calibrate
from daq.jobs.context import Tools
from daq.jobs.guided import GuidedSettings
from daq.jobs.journal import Form, Journal
from daq.jobs.operator import GivenAnswers, Operator
from daq.jobs.reporting import Conclusion
from daq.workflow.plan import Plan, plan
from daq.workflow.validate import Validation
from ident.calibration import Calibration
from tests.daq.jobs.made import Made
from tests.daq.jobs.rig import WHO, Rig, make_rig, powerless, serving

BLOCK_S = 6.0
TARGET_PERCENT = 5.0  #: Three blocks of that length reach it
MASS_KG = 4.59


@dataclass(frozen=True)
class MadeSession(Made):
    """Products of a whole guided session.

    Attributes:
        plans: by their seeds.
        before, after: what the gains of before and of after the write predict of the acceptance
            run.
    """

    plans: dict[int, Plan]
    before: Validation
    after: Validation

    def _plan_of(self, _cell: Cell, *, seed: int, duration_s: float, **_further: Any) -> Plan:
        return self.plans[seed]

    def tools(self, rig: Rig, **factors: float) -> Tools:
        """As for a job, with plans and predictions."""

        def predicted(
            calibration: Calibration, logs: Sequence[Path], cell: Cell
        ) -> tuple[Validation, ...]:
            own = [gain.value for gain in self.calibration.gains]
            gains = [gain.value for gain in calibration.gains]
            is_new = gains == own
            return (self.after if is_new else self.before,)

        return replace(
            super().tools(rig, **factors),
            plan=self._plan_of,
            look=lambda *_: BlockFacts(),
            geometry=lambda *_: None,
            preview=lambda _cell, _plan, _file, page: page.touch(),
            validate=predicted,
        )


def settings_of(rig: Rig, **changed: Any) -> GuidedSettings:
    """Settings of the session that was made."""
    folder = rig.cells / "demo.sessions"
    settings = GuidedSettings(
        folder,
        "disc",
        target_percent=TARGET_PERCENT,
        block_s=BLOCK_S,
        min_free_mb=1.0,
    )
    return replace(settings, **changed)


def given_answers(rig: Rig, **changed: Any) -> GivenAnswers:
    """An operator who mounts what is asked for, and writes."""

    def put(payload: str | None) -> None:
        mounted_folder = rig.cells / "mounted"
        mounted_folder.write_text(f"{payload or 'none'}\n")

    return replace(GivenAnswers(WHO, {"disc": MASS_KG}, put, "the test"), **changed)


def run_session(rig: Rig, operator: Operator | None = None, **changed: Any) -> Conclusion:
    """Begin a session, or go on with it.

    Args:
        rig: the cell.
        operator: None for one who does and approves everything.
        changed: settings.
    """
    journal = Journal(rig.said, Form.JSON, lambda: rig.clock.at)
    settings = settings_of(rig, **changed)
    return calibrate(
        rig.cell_file,
        rig.cell,
        settings,
        operator or given_answers(rig),
        rig.tools,
        journal,
        lock_folder=rig.folder,
    )


def session_rig(folder: Path, **section: Any) -> Rig:
    """A rig for guided sessions."""
    plan_file = folder / "no-plan.yaml"
    rig = make_rig(folder, plan_file, **section)
    rig.kind = "sessions"
    (rig.cells / "mounted").write_text("none\n")
    return rig


def made_session_rig(folder: Path, made: MadeSession, **section: Any) -> Rig:
    """A rig whose recordings are copies of those that were made."""
    rig = session_rig(folder, **section)
    rig.tools = made.tools(rig)
    return rig


def whole_session(folder: Path) -> tuple[Rig, MadeSession]:
    """A real session from the first frame to the acceptance, and what it made.

    Args:
        folder: of the cell; empty.
    """
    rig = session_rig(folder)
    made: dict[str, list[Any]] = {}
    plans: dict[int, Plan] = {}
    tools = rig.tools

    def keep(name: str) -> Any:
        def called(*given: Any, **further: Any) -> Any:
            found = getattr(tools, name)(*given, **further)
            made.setdefault(name, []).append(found)
            return found

        return called

    def quick_plan(cell: Cell, *, seed: int, duration_s: float, **_further: Any) -> Plan:
        plans[seed] = plan(
            cell,
            seed=seed,
            duration_s=duration_s,
            exchanges=100,
            largest_condition=1e6,
            largest_std_percent=100.0,
        )
        return plans[seed]

    names = ("record", "fit", "close_loop", "account", "calibration", "validate")
    rig.tools = replace(tools, plan=quick_plan, **{name: keep(name) for name in names})
    with serving(rig) as cell_there:
        run_session(rig)
        assert powerless(cell_there)
    recorded = {found.path.stem: found for found in made["record"]}
    before, after = (found for (found,) in made["validate"])
    logs = {name: found.path for name, found in recorded.items()}
    fitted = made["fit"][-1]
    closed = made["close_loop"][-1]
    changed = made["account"][-1]
    calibration = made["calibration"][-1]
    plan_file = folder / "no-plan.yaml"
    session = MadeSession(
        plan_file=plan_file,
        logs=logs,
        recorded=recorded,
        fitted=fitted,
        closed=closed,
        changed=changed,
        calibration=calibration,
        plans=plans,
        before=before,
        after=after,
    )
    return rig, session
