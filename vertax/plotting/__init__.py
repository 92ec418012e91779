"""Figures of tissues, fits and measurements."""

from vertax._base.extras import requires_extra as _requires_extra
from vertax.mesh import cell_polygons as cell_polygons

with _requires_extra("plot", "Drawing"):
    from vertax.plotting._animation import (
        animate as animate,
        animate_figures as animate_figures,
        flipped_edges as flipped_edges,
    )
    from vertax.plotting._curves import plot_history as plot_history
    from vertax.plotting._image import (
        label_colours as label_colours,
        plot_image as plot_image,
        scale_bar as scale_bar,
    )
    from vertax.plotting._mechanics import (
        plot_mode as plot_mode,
        plot_stress as plot_stress,
    )
    from vertax.plotting._napari import tension_layer as tension_layer
    from vertax.plotting._panels import plot_tissues as plot_tissues
    from vertax.plotting._recovery import plot_recovery as plot_recovery
    from vertax.plotting._style import (
        INK as INK,
        SERIES as SERIES,
        house_style as house_style,
        new_figure as new_figure,
    )
    from vertax.plotting._surface import plot_surface as plot_surface
    from vertax.plotting._tension_map import plot_tensions as plot_tensions
    from vertax.plotting._tissue import plot_tissue as plot_tissue
