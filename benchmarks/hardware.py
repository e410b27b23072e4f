"""What a measurement was made on, and the root of the checkout."""

from instant_avatar.cli.hardware import ROOT as ROOT
from instant_avatar.cli.hardware import Hardware as Hardware
