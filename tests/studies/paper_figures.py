"""The paper's own figures, for comparison with ours:
Gautier and Briot, doi 10.1115/1.4027506, Tables 1 to 8.
"""

from __future__ import annotations

from daq.report.paper_tables import PaperTable

SETS = ("manufacturer", "case 1", "case 2", "case 3", "case 4")


def _rows(table: str) -> tuple[tuple[str, ...], ...]:
    """Cells of a table that has a line a row, and `|` between columns."""
    rows = []
    for line in table.strip().splitlines():
        cells = line.split("|")
        rows.append(tuple(cell.strip() for cell in cells))
    return tuple(rows)


_PARAMETERS_1 = _rows("""
    essential parameters of the robot |    29 |    31
    mean %e                           |       |  7.86
    ‖ρ‖/‖Y‖ [%]                       | 12.40 | 12.43
""")
_PARAMETERS_3 = _rows("""
    essential parameters of the robot |    28 |    32
    mean %e                           |       |  8.28
    ‖ρ‖/‖Y‖ [%]                       | 11.95 | 11.15
""")
_GAINS_2 = _rows("""
    1    |  32.96 | 30.20 | 2.41 |  8.37 | 31.10 | 2.02 |  5.64
    2    |  32.96 | 29.80 | 1.72 |  9.59 | 30.50 | 1.09 |  7.46
    3    |  25.65 | 21.80 | 2.36 | 15.01 | 22.40 | 1.74 | 12.67
    4    | -11.52 | -8.06 | 3.33 | 30.03 | -8.27 | 1.76 | 28.21
    5    |  18.48 | 14.00 | 3.10 | 24.24 | 14.40 | 1.36 | 22.08
    6    |   7.68 |  5.88 | 3.15 | 23.44 |  6.08 | 1.44 | 20.83
    mean |        |       |      | 18.45 |       |      |  16.5
""")
_GAINS_4 = _rows("""
    1    |  32.96 | 33.80 | 1.83 |  2.55 | 33.90 | 1.87 |  2.85
    2    |  32.96 | 31.50 | 1.10 |  4.43 | 32.40 | 1.36 |  1.70
    3    |  25.65 | 23.50 | 1.70 |  8.38 | 24.20 | 1.87 |  5.65
    4    | -11.52 | -8.31 | 1.99 | 27.86 | -9.21 | 2.75 | 20.05
    5    |  18.48 | 14.50 | 1.71 | 21.54 | 16.30 | 2.53 | 11.80
    6    |   7.68 |  6.12 | 1.76 | 20.31 |  6.79 | 2.57 | 11.59
    mean |        |       |      | 14.18 |       |      |  8.94
""")
_CONDITION_5 = _rows("""
    cond(W) | 2177 | 2817 | 1930
""")
_ERRORS_6 = _rows("""
    Traj. 1, J1 | 12.83 | 12.64 | 12.46 | 12.67 | 12.52
    Traj. 1, J2 |  9.96 |  9.82 | 10.04 | 10.39 |  9.72
    Traj. 1, J3 | 25.80 | 26.03 | 26.32 | 25.53 | 26.00
    Traj. 1, J4 | 15.20 | 14.88 | 14.35 | 16.91 | 14.30
    Traj. 1, J5 | 35.06 | 35.98 | 35.27 | 33.54 | 35.41
    Traj. 1, J6 | 19.36 | 21.11 | 19.94 | 24.10 | 19.86
    Traj. 2, J1 | 11.44 | 11.41 | 11.23 | 11.38 | 11.29
    Traj. 2, J2 |  7.66 |  7.81 |  8.04 |  7.60 |  7.46
    Traj. 2, J3 | 24.36 | 24.72 | 24.72 | 24.50 | 24.35
    Traj. 2, J4 | 12.24 | 11.30 | 10.88 | 11.31 | 10.89
    Traj. 2, J5 | 30.36 | 31.55 | 30.64 | 31.47 | 30.50
    Traj. 2, J6 | 15.36 | 18.00 | 15.71 | 17.78 | 15.45
    Traj. 3, J1 |  9.18 |  8.73 |  8.73 |  8.82 |  8.70
    Traj. 3, J2 |  7.29 |  7.28 |  7.42 |  7.07 |  6.92
    Traj. 3, J3 | 24.78 | 25.39 | 25.26 | 25.24 | 24.86
    Traj. 3, J4 | 13.06 | 12.76 | 12.09 | 12.77 | 12.12
    Traj. 3, J5 | 33.71 | 35.06 | 33.66 | 35.05 | 33.72
    Traj. 3, J6 | 16.26 | 19.28 | 16.53 | 19.09 | 16.23
    mean        | 17.99 | 18.54 | 17.96 | 18.62 | 17.79
""")
_MASSES_7 = _rows("""
    Traj. 1, kg | 4.44 | 4.32 | 4.22 | 4.53 | 4.57
    %σ          | 1.68 | 1.54 | 1.54 | 1.54 | 1.56
    %e          | 3.27 | 5.88 | 8.06 | 1.31 | 0.44
    Traj. 2, kg | 4.44 | 4.29 | 4.19 | 4.50 | 4.54
    %σ          | 1.18 | 1.09 | 1.09 | 1.08 | 1.10
    %e          | 3.27 | 6.54 | 8.71 | 1.96 | 1.09
    Traj. 3, kg | 4.46 | 4.31 | 4.21 | 4.53 | 4.57
    %σ          | 1.03 | 0.94 | 0.94 | 0.94 | 0.95
    %e          | 2.83 | 6.10 | 8.28 | 1.31 | 0.44
    mean %e     | 3.12 | 6.17 | 8.35 | 1.53 | 0.65
""")
_MASSES_8 = _rows("""
    Traj. 1, kg | 1.67 | 1.58 | 1.55 | 1.66 | 1.68
    %σ          | 2.61 | 2.51 | 2.51 | 2.49 | 2.53
    %e          | 0.95 | 6.29 | 8.07 | 1.54 | 0.36
    Traj. 2, kg | 1.70 | 1.60 | 1.56 | 1.68 | 1.70
    %σ          | 1.92 | 1.87 | 1.87 | 1.86 | 1.88
    %e          | 0.83 | 5.10 | 7.47 | 0.36 | 0.83
    Traj. 3, kg | 1.70 | 1.59 | 1.56 | 1.67 | 1.70
    %σ          | 1.94 | 1.89 | 1.89 | 1.88 | 1.89
    %e          | 0.83 | 5.69 | 7.47 | 0.95 | 0.83
    mean %e     | 0.87 | 5.69 | 7.67 | 0.95 | 0.67
""")

_PARAMETER_HEADINGS = ("", "10 CAD", "mass alone")
_GAIN_HEADINGS = ("axis", "nameplate", "10 CAD: gain", "%σ", "%e", "mass alone: gain", "%σ", "%e")

_TABLES = {
    1: PaperTable("the paper's Table 1", _PARAMETER_HEADINGS, _PARAMETERS_1),
    2: PaperTable("the paper's Table 2", _GAIN_HEADINGS, _GAINS_2),
    3: PaperTable("the paper's Table 3", _PARAMETER_HEADINGS, _PARAMETERS_3),
    4: PaperTable("the paper's Table 4", _GAIN_HEADINGS, _GAINS_4),
    5: PaperTable("the paper's Table 5", ("", "Traj. 1", "Traj. 2", "Traj. 3"), _CONDITION_5),
    6: PaperTable("the paper's Table 6", ("run, joint", *SETS), _ERRORS_6),
    7: PaperTable("the paper's Table 7: 4.59 kg", ("run", *SETS), _MASSES_7),
    8: PaperTable("the paper's Table 8: 1.686 kg", ("run", *SETS), _MASSES_8),
}


def paper_table(number: int) -> PaperTable:
    """A table of the paper; of the parameter tables only what can be compared between two
    robots.
    """
    return _TABLES[number]
