"""Pictures of tissues and of fits."""

from vertax._base.extras import needing as _needing
from vertax.mesh._outlines import cell_polygons as cell_polygons

with _needing("plot", "Drawing"):
    from vertax.plotting._animation import animate as animate, flipped_edges as flipped_edges
    from vertax.plotting._curves import (
        plot_history as plot_history,
        plot_recovery as plot_recovery,
    )
    from vertax.plotting._tissue import plot_tissue as plot_tissue
