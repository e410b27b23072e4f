"""What a measurement was made on, and the root of the checkout."""

from apps.report.hardware import ROOT as ROOT
from apps.report.hardware import Hardware as Hardware
