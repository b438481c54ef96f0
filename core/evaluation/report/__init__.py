"""A comparison as something to look at: one page that needs nothing else, and its plots as files."""

from core.evaluation.report.page import write_report

__all__ = ["write_report"]
