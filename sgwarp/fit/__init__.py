"""From photographs to Gaussians."""

from sgwarp.fit.settings import FitSettings as FitSettings
from sgwarp.fit.training import Fitted as Fitted
from sgwarp.fit.training import fit as fit
