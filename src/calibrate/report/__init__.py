"""One self-contained HTML page of a posterior, for a colleague: verdict, data, body, provenance.

It opens without a network: the drawing library is inside.
"""

from calibrate.report.page import write_report

__all__ = ["write_report"]
