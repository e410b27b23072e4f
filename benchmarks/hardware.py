"""What a measurement was made on, and the root of the checkout."""

from apps.cli.hardware import ROOT as ROOT
from apps.cli.hardware import Hardware as Hardware
