"""Depth of what moves, which no flow triangulates: from where it touches the ground, and from how it grows.

A region of the image that moves is taken for upright, at one depth. From frame to frame its size tells how this
changes, to a per cent or two. Its scale is that of the ground where the region touches it; one such scale holds for all
frames in which the region is followed, whichever show its feet.
"""

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
"""If a smaller share of what is followed, by area, is not cut off, it counts as always cut off."""
CONTACT = 0.2
"""Standard deviation of the logarithm of the inverse depth of a contact: of a region of mean area."""
NEAR = 0.05
"""Errors of contacts count by their square up to here, then by their size: of many a quantile decides."""
IN_FRONT = 0.8
"""Quantile of the contacts of what is not always cut off: it may leave the ground, but is never behind it."""
BENDS = 0.02
"""Change of log size over a frame that is none of depth: things bend and turn."""
ITERATIONS = 30


def placed(maps: DepthMaps, numbers: np.ndarray, links: Links, focals_px: np.ndarray) -> DepthMaps:
    """The maps [T, h, w] with one inverse depth for each of the regions `numbers` [T, h, w] that move.

    Args:
        links: between these regions. focals_px: [T], of each frame.
    """
    if not numbers.any():
        return maps
    count = int(numbers.max()) + 1
    contact, cut, area, frame = np.full(count, np.nan), np.zeros(count, bool), np.zeros(count), np.zeros(count, int)
    for k, regions in enumerate(numbers):
        for region in np.unique(regions[regions > 0]):
            frame[region], area[region] = k, (regions == region).sum()
            if not maps.filled[k].all():
                found = contact_inverse_depth(regions == region, maps.inverse_depth[k], ~maps.filled[k])
                contact[region], cut[region] = np.log(max(found[0], INVERSE_DEPTHS[0])), found[1]
    zoomed = np.log(focals_px[frame[links.target]] / focals_px[frame[links.source]])
    logs = consistent(contact, cut, area, links._replace(log_growth=links.log_growth - zoomed))
    inverse_depth = np.where(numbers > 0, np.exp(logs)[numbers], maps.inverse_depth)
    return DepthMaps(inverse_depth, maps.variance, maps.filled)


def consistent(contact: np.ndarray, cut: np.ndarray, area: np.ndarray, links: Links) -> np.ndarray:
    """Log inverse depth [n] of regions: near that of their contacts, and changing as they grow.

    Minimises sum_i w_i |z_i - c_i| + sum_ij v_ij (z_j - z_i - g_ij)^2 by iteratively reweighted least squares, w_i such
    that of several contacts the quantile IN_FRONT decides. Of what is seen to touch the ground in some frames, the
    others only say that it is not behind the ground at the edge that cuts it off. What is cut off always is nearer than
    that, by CUT_OFF. Things that meet in one region come out at one depth, or between theirs.

    Args:
        contact: [n] log inverse depth of the ground where a region touches it, or at the edge that cuts it off, `cut`;
            NaN: nothing is known of it.
        area: [n] of the regions in pixels.
    """
    known = np.isfinite(contact)
    always_cut = _always(cut, known * area, links)
    measured = np.where(known, contact + np.where(always_cut, np.log(CUT_OFF), 0.0), 0.0)
    share = links.pixels / np.maximum(1, np.maximum(area[links.source], area[links.target]))
    stiff = share / (BENDS**2 * links.gap + links.sigma**2)
    between = _differences(links, len(contact))
    followed, grown = between.T @ sparse.diags_array(stiff) @ between, between.T @ (stiff * links.log_growth)
    trust = known * area / max(float(area.mean()), 1e-12) / CONTACT
    if_behind, if_before = (np.where(always_cut, 1.0, 2 * tail) for tail in (IN_FRONT, 1 - IN_FRONT))
    pull = np.where(cut == always_cut, trust / NEAR, 0.0) + 1e-9
    for _ in range(ITERATIONS):
        z = spsolve((followed + sparse.diags_array(pull)).tocsc(), grown + pull * measured)
        behind = z < measured
        weight = trust * np.where(behind, if_behind, if_before) / np.maximum(np.abs(z - measured), NEAR)
        pull = np.where((cut == always_cut) | (cut & behind), weight, 0.0) + 1e-9
    return np.asarray(z)


def _always(cut: np.ndarray, area: np.ndarray, links: Links) -> np.ndarray:
    """Which regions [n] are of something that the lower edge always cuts off, but for a share SEEN of its area."""
    n = len(cut)
    pairs = sparse.coo_array((np.ones(len(links.gap)), (links.source, links.target)), (n, n))
    _, things = connected_components(pairs, directed=False)
    seen, whole = (np.bincount(things, values, n)[things] for values in (area * ~cut, area))
    return np.asarray(seen < SEEN * whole)


def _differences(links: Links, n: int) -> sparse.csr_array:
    """The matrix that takes n values to those of the target less those of the source of each link."""
    rows = np.arange(len(links.gap))
    values = np.concatenate([np.ones(len(rows)), -np.ones(len(rows))])
    at = np.concatenate([rows, rows]), np.concatenate([links.target, links.source])
    return sparse.coo_array((values, at), (len(rows), n)).tocsr()


def contact_inverse_depth(region: np.ndarray, inverse_depth: np.ndarray, measured: np.ndarray) -> tuple[float, bool]:
    """Inverse depth of the ground where a region [h, w] touches it, and whether the lower edge cuts the region off.

    The median over the measured pixels just below its lowest quarter. What the lower edge of the image cuts off touches
    the ground outside of the image: then it is the median of the ground at the edge beside it. If nothing is measured
    there, it is the near end (80th percentile) of the measurements around it, since the region occludes them.
    """
    ground = inverse_depth[_beside_cut(region) & measured]
    if ground.size:
        return float(np.median(ground)), True
    rows = np.flatnonzero(region.any(axis=1))
    below = np.zeros_like(region)
    below[1:] = region[:-1] & ~region[1:]
    below[: rows[-1] + 2 - max(1, (rows[-1] - rows[0] + 1) // 4)] = False
    contact = inverse_depth[below & measured]
    if contact.size:
        return float(np.median(contact)), False
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    around = inverse_depth[(cv2.dilate(region.astype(np.uint8), cross, iterations=2) > 0) & measured]
    return float(np.percentile(around if around.size else inverse_depth[measured], 80)), False


def _beside_cut(region: np.ndarray) -> np.ndarray:
    """The lowest rows [h, w] beside a region that the lower edge of the image cuts off; false where it does not."""
    h, beside = len(region), np.zeros_like(region)
    cut = np.flatnonzero(region[-1])
    if cut.size:
        reach = max(8, cut.size)
        beside[h - max(2, h // 16) :, max(0, cut[0] - reach) : cut[-1] + 1 + reach] = True
    return beside & ~region
