"""The forms in which a graph can hold the parts of a network.

Every form computes the same from the same weights, but for rounding, in steps that runtimes are
faster at. `formed` chooses between the forms of the 3D convs, which depend on the device;
`rewritten` puts everything else into the form that graphs for a runtime always have.
"""

from .banded import Banded, Formed, formed, forms_run
from .head import class_ids, class_ids_by_maxima
from .matching import ROWS, enlarge_by_products
from .rewritten import rewritten, steps_for

__all__ = ["ROWS", "Banded", "Formed", "class_ids", "class_ids_by_maxima", "enlarge_by_products"]
__all__ += ["formed", "forms_run", "rewritten", "steps_for"]
