"""See `sgwarp.reconstruction.fitting.photographs`."""

from sgwarp.reconstruction.fitting.belongings import masks_from_folder as masks_from_folder
from sgwarp.reconstruction.fitting.photographs import read_photographs as read_photographs
