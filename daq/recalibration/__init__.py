"""The scheduled recalibration: preflight, record, fit, decide, propose or apply, report."""
