"""A comparison as something to look at: one page that needs nothing else, and its charts as files."""

from lab.evaluation.report.page import write_report

__all__ = ["write_report"]
