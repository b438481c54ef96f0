"""A comparison as something to look at: one page that needs nothing else, and its charts as files."""

from core.evaluation.report.page import check_installed, write_report

__all__ = ["check_installed", "write_report"]
