"""Depth of what moves, which no flow triangulates: from where it touches the ground, and from how it grows.

A region of the image that moves is taken for upright, at one depth. From frame to frame its size tells how this
changes, to a per cent or two. Its scale is that of the ground where the region touches it; one such scale holds for all
frames in which the region is followed, whichever show its feet.
"""

from enum import IntEnum

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve

from stages.ba.depth import DepthMaps
from stages.ba.growth import Links
from stages.ba.state import INVERSE_DEPTHS

CUT_OFF = 1.6
"""Inverse depth of what the lower edge of the image always cuts off, over that of the ground at the edge beside it. The
true one is 1.3 to 1.9 (eight movers of tuned scenes)."""
SEEN = 0.1
"""Share, by area, of the regions of a thing that have a kind of contact, from which on it decides."""
CONTACT = 0.2
"""Standard deviation of the logarithm of the inverse depth of a contact: of a region of mean area, by cells."""
NEAR = 0.05
"""Errors of contacts count by their square up to here, then by their size: of many a quantile decides."""
IN_FRONT = 0.8
"""Quantile of the contacts of what is not always cut off: it may leave the ground, but is never behind it."""
BENDS = 0.02
"""Change of log size over a frame that is none of depth: things bend and turn."""
ITERATIONS, CONVERGED = 30, 1e-3


class Contact(IntEnum):
    """What is known of where a region touches the ground; what comes first decides if there is enough of it."""

    FEET = 0  # the ground that it stands on
    EDGE = 1  # the lower edge of the image cuts it off: the ground at the edge beside it
    AROUND = 2  # no ground is measured there: what it hides


def placed(maps: DepthMaps, numbers: np.ndarray, links: Links, focals_px: np.ndarray) -> DepthMaps:
    """The maps [T, h, w] with one inverse depth for each of the regions `numbers` [T, h, w] that move.

    Args:
        links: between these regions. focals_px: [T], of each frame.
    """
    if not numbers.any():
        return maps
    count = int(numbers.max()) + 1
    contact, kind, frame = np.full(count, np.nan), np.full(count, Contact.AROUND), np.zeros(count, int)
    for k, regions in enumerate(numbers):
        for number in np.unique(regions[regions > 0]):
            frame[number] = k
            if not maps.filled[k].all():
                found, kind[number] = contact_inverse_depth(regions == number, maps.inverse_depth[k], ~maps.filled[k])
                contact[number] = np.log(max(found, INVERSE_DEPTHS[0]))
    zoomed = np.log(focals_px[frame[links.target]] / focals_px[frame[links.source]])
    area = np.bincount(numbers.ravel()) * (np.arange(count) > 0)
    logs = consistent(contact, kind, area, links._replace(log_growth=links.log_growth - zoomed))
    inverse_depth = np.where(numbers > 0, np.exp(logs).clip(*INVERSE_DEPTHS)[numbers], maps.inverse_depth)
    return DepthMaps(inverse_depth, maps.variance, maps.filled)


def consistent(contact: np.ndarray, kind: np.ndarray, area: np.ndarray, links: Links) -> np.ndarray:
    """Log inverse depth [n] of regions: near that of their contacts, and changing as they grow.

    Minimises sum_i w_i |z_i - c_i| + 1/2 sum_ij v_ij (z_j - z_i - g_ij)^2 by iteratively reweighted least squares, w_i
    such that of several contacts the quantile IN_FRONT decides. Of what is seen to touch the ground in some frames, the
    others only say that it is not behind the ground at the edge that cuts it off. What is cut off always is nearer than
    that, by CUT_OFF. Of what has no measured ground beside it either, the surroundings decide, which it hides.

    Args:
        contact: [n] log inverse depth, NaN where nothing is known. kind: [n] `Contact`.
        area: [n] of the regions in pixels.
    """
    known = np.isfinite(contact)
    deciding = _deciding(kind, known * area, links)
    always_cut = deciding == Contact.EDGE
    measured = np.where(known, contact + np.where(always_cut & (kind == deciding), np.log(CUT_OFF), 0.0), 0.0)
    share = links.pixels / np.maximum(1, np.maximum(area[links.source], area[links.target]))
    stiff = share / (BENDS**2 * links.gap + links.sigma**2)
    between = _differences(links, len(contact))
    followed, grown = between.T @ sparse.diags_array(stiff) @ between, between.T @ (stiff * links.log_growth)
    trust = known * area / max(float((area**2).sum() / max(area.sum(), 1e-12)), 1e-12) / CONTACT
    if_behind, if_before = (np.where(always_cut, 1.0, 2 * tail) for tail in (IN_FRONT, 1 - IN_FRONT))
    pull, z = np.where(kind == deciding, trust / NEAR, 0.0) + 1e-9, measured
    for _ in range(ITERATIONS):
        before = z
        z = spsolve((followed + sparse.diags_array(pull)).tocsc(), grown + pull * measured)
        if np.abs(z - before).max() < CONVERGED:
            break
        behind = z < measured
        weight = trust * np.where(behind, if_behind, if_before) / np.maximum(np.abs(z - measured), NEAR)
        pull = np.where((kind == deciding) | ((kind == Contact.EDGE) & behind), weight, 0.0) + 1e-9
    return np.asarray(z)


def _deciding(kind: np.ndarray, area: np.ndarray, links: Links) -> np.ndarray:
    """The kind [n] of contact that decides on the thing of each region: the first that a share SEEN of its area has."""
    n = len(kind)
    pairs = sparse.coo_array((np.ones(len(links.gap)), (links.source, links.target)), (n, n))
    _, things = connected_components(pairs, directed=False)
    whole = np.bincount(things, area)
    enough = np.stack([np.bincount(things, area * (kind == one)) >= SEEN * whole for one in Contact])
    return np.asarray(enough.argmax(axis=0)[things])


def _differences(links: Links, n: int) -> sparse.csr_array:
    """The matrix that takes n values to those of the target less those of the source of each link."""
    rows = np.arange(len(links.gap))
    values = np.concatenate([np.ones(len(rows)), -np.ones(len(rows))])
    at = np.concatenate([rows, rows]), np.concatenate([links.target, links.source])
    return sparse.coo_array((values, at), (len(rows), n)).tocsr()


def contact_inverse_depth(region: np.ndarray, inverse_depth: np.ndarray, measured: np.ndarray) -> tuple[float, Contact]:
    """Inverse depth of the ground where a region [h, w] touches it, and which ground that is.

    The median over the measured pixels just below its lowest quarter. What the lower edge of the image cuts off touches
    the ground outside of the image: then it is the median of the ground at the edge beside it. If nothing is measured
    there, it is the near end (80th percentile) of the measurements around it, since the region occludes them.
    """
    kind, ground = Contact.EDGE, _beside_cut(region)
    if not region[-1].any():
        kind, rows = Contact.FEET, np.flatnonzero(region.any(axis=1))
        ground[1:] = region[:-1] & ~region[1:]
        ground[: rows[-1] + 2 - max(1, (rows[-1] - rows[0] + 1) // 4)] = False
    if (ground & measured).any():
        return float(np.median(inverse_depth[ground & measured])), kind
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    around = inverse_depth[(cv2.dilate(region.astype(np.uint8), cross, iterations=2) > 0) & measured]
    return float(np.percentile(around if around.size else inverse_depth[measured], 80)), Contact.AROUND


def _beside_cut(region: np.ndarray) -> np.ndarray:
    """The lowest rows [h, w] beside a region that the lower edge of the image cuts off; false where it does not."""
    h, beside = len(region), np.zeros_like(region)
    cut = np.flatnonzero(region[-1])
    if cut.size:
        reach = max(8, cut.size)
        beside[h - max(2, h // 16) :, max(0, cut[0] - reach) : cut[-1] + 1 + reach] = True
    return beside & ~region
