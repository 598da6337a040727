"""The compiled inner loops of rendering: rays meet the ground, pixels take their texture.

They stand in one file because numba's cache knows a function's own file only: a kernel that calls one in
another file would go on using the old one after that has changed.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

TILE = 128  # texels per side of a tile
FINEST_EXPONENT = 12  # level 0 has texels of 2**-12 m
LEVELS = 22
BLOCK = 8  # cells per side of a block of the height field whose highest point is known, for skipping
SKY = 0.8  # radiance of rays that never meet the ground
_PER_METRE = 2.0 ** (FINEST_EXPONENT - np.arange(LEVELS + 1.0))  # texels per metre of each level


@njit(cache=True, nogil=True, error_model="numpy")
def tile_key(level, i, j):  # type: ignore[no-untyped-def]
    """One integer for the tile of this level whose first texel is texel (i, j) * TILE."""
    return (level << 48) | ((i + 0x800000) << 24) | (j + 0x800000)


@njit(cache=True, nogil=True, error_model="numpy")
def table_entry(key):  # type: ignore[no-untyped-def]
    level, i, j = key >> 48, (key >> 24) & 0xFFFFFF, key & 0xFFFFFF
    return (level * 64 + (j & 63)) * 64 + (i & 63)


@njit(cache=True, nogil=True, error_model="numpy")
def find_tile(key, keys, table):  # type: ignore[no-untyped-def]
    """Slot of the tile in the pool, or -1."""
    slot = table[table_entry(key)]
    if slot >= 0 and keys[slot] == key:
        return slot
    return -1


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _patch_crossing(z, r, c, u, v, w, du, dv, dw, t0, t1):  # type: ignore[no-untyped-def]
    """First t in [t0, t1] where the ray (u, v in cells, w in metres) meets the bilinear patch of cell (r, c);
    -1 if none.
    """
    a = float(z[r, c])
    b, e = z[r, c + 1] - a, z[r + 1, c] - a
    f = z[r + 1, c + 1] - a - b - e
    p, q = u - c, v - r
    # w + dw t = a + b (p + du t) + e (q + dv t) + f (p + du t)(q + dv t)
    c2 = -f * du * dv
    c1 = dw - b * du - e * dv - f * (p * dv + q * du)
    c0 = w - a - b * p - e * q - f * p * q
    slack = 1e-9 * (1.0 + abs(t1))
    if c0 + t0 * (c1 + t0 * c2) <= 0.0:
        return t0
    if abs(c2) < 1e-12 * abs(c1):
        t = -c0 / c1
        return t if t0 - slack <= t <= t1 + slack else -1.0
    disc = c1 * c1 - 4.0 * c2 * c0
    if disc < 0.0:
        return -1.0
    s = -0.5 * (c1 + math.copysign(math.sqrt(disc), c1))
    first, second = s / c2, c0 / s if s != 0.0 else -1.0
    if second < first:
        first, second = second, first
    if t0 - slack <= first <= t1 + slack:
        return first
    if t0 - slack <= second <= t1 + slack:
        return second
    return -1.0


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _walk_cells(z, u, v, w, du, dv, dw, per_u, per_v, t0, t1):  # type: ignore[no-untyped-def]
    """Walk the cells between t0 and t1 (Amanatides and Woo 1987) and return the first crossing, or -1.

    per_u, per_v: 1 / du and 1 / dv.
    """
    rows, cols = z.shape
    middle = t0 + 1e-9 * (1.0 + abs(t0))
    c = min(max(math.floor(u + du * middle), 0), cols - 2)
    r = min(max(math.floor(v + dv * middle), 0), rows - 2)
    t = t0
    for _ in range(8 * BLOCK):
        next_u = ((c + 1 if du > 0.0 else c) - u) * per_u
        next_v = ((r + 1 if dv > 0.0 else r) - v) * per_v
        leave = min(next_u, next_v, t1)
        top = max(z[r, c], z[r, c + 1], z[r + 1, c], z[r + 1, c + 1])
        if w + dw * leave <= top + 1e-6:
            hit = _patch_crossing(z, r, c, u, v, w, du, dv, dw, t, leave)
            if hit >= 0.0:
                return hit
        if leave >= t1:
            return -1.0
        if next_u <= next_v:
            c += 1 if du > 0.0 else -1
        else:
            r += 1 if dv > 0.0 else -1
        if c < 0 or r < 0 or c > cols - 2 or r > rows - 2:
            return -1.0
        t = max(t, leave)
    return -1.0


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def meet_ground(ox, oy, oz, dx, dy, dz, z, blocks, frame):  # type: ignore[no-untyped-def]
    """Distance along a descending ray to the ground, in units of its direction; inf when it does not come
    down.

    frame: x0, y0, cell, border height, lowest, highest. Beyond the grid the ground is the plane at border
    height.
    """
    cell, border, lowest, highest = frame[2], frame[3], frame[4], frame[5]
    if dz > -1e-3:
        return math.inf
    per_z, per_cell = 1.0 / dz, 1.0 / cell
    if highest - lowest < 1e-9:
        return (highest - oz) * per_z
    u, v = (ox - frame[0]) * per_cell, (oy - frame[1]) * per_cell
    # A ray that is exactly upright in one axis is leant by far less than a texel, so that it has a next cell.
    du, dv = dx * per_cell, dy * per_cell
    du, dv = (du if abs(du) > 1e-12 else 1e-12), (dv if abs(dv) > 1e-12 else 1e-12)
    per_u, per_v = 1.0 / du, 1.0 / dv
    t = max(0.0, (highest - oz) * per_z)
    end = (lowest - oz) * per_z
    plane = (border - oz) * per_z
    while t <= end:
        nudge = t + 1e-9 * (1.0 + t)
        bc = math.floor((u + du * nudge) * (1.0 / BLOCK))
        br = math.floor((v + dv * nudge) * (1.0 / BLOCK))
        next_u = ((bc + 1 if du > 0.0 else bc) * BLOCK - u) * per_u
        next_v = ((br + 1 if dv > 0.0 else br) * BLOCK - v) * per_v
        leave = max(min(next_u, next_v), nudge)
        if 0 <= bc < blocks.shape[1] and 0 <= br < blocks.shape[0]:
            if oz + dz * leave <= blocks[br, bc] + 1e-6:
                enter = max(t, (blocks[br, bc] + 1e-6 - oz) * per_z)
                hit = _walk_cells(z, u, v, oz, du, dv, dz, per_u, per_v, enter, min(leave, end + 1e-6))
                if hit >= 0.0:
                    return hit
        elif t <= plane <= leave:
            return plane
        t = leave
    return max(plane, 0.0) if plane >= 0.0 else end


@njit(cache=True, nogil=True, error_model="numpy")
def ray_ranges(origins, directions, z, blocks, frame, out):  # type: ignore[no-untyped-def]
    for n in range(len(out)):
        out[n] = meet_ground(
            origins[n, 0], origins[n, 1], origins[n, 2],
            directions[n, 0], directions[n, 1], directions[n, 2], z, blocks, frame,
        )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _note(wanted, count, key):  # type: ignore[no-untyped-def]
    """Append key to wanted unless the last few are the same; the rest of the duplicates are dropped later."""
    for k in range(max(0, count - 8), count):
        if wanted[k] == key:
            return count
    if count < len(wanted):
        wanted[count] = key
        return count + 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _cloud_light(clouds, cloud, x, y):  # type: ignore[no-untyped-def]
    """Periodic bilinear look-up of the light that clouds let through."""
    rows, cols = clouds.shape
    per_cell = 1.0 / cloud[0]
    u, v = (x - cloud[1]) * per_cell, (y - cloud[2]) * per_cell
    c, r = math.floor(u), math.floor(v)
    fu, fv = u - c, v - r
    c0, r0 = c % cols, r % rows
    c1, r1 = c0 + 1 if c0 + 1 < cols else 0, r0 + 1 if r0 + 1 < rows else 0
    low = clouds[r0, c0] * (1.0 - fu) + clouds[r0, c1] * fu
    high = clouds[r1, c0] * (1.0 - fu) + clouds[r1, c1] * fu
    return low * (1.0 - fv) + high * fv


@njit(cache=True, nogil=True, error_model="numpy")
def _grid_light(light, frame, x, y):  # type: ignore[no-untyped-def]
    rows, cols = light.shape
    per_cell = 1.0 / frame[2]
    u, v = (x - frame[0]) * per_cell, (y - frame[1]) * per_cell
    if not (0.0 <= u < cols - 1 and 0.0 <= v < rows - 1):
        return 1.0
    c, r = int(u), int(v)
    fu, fv = u - c, v - r
    low = light[r, c] * (1.0 - fu) + light[r, c + 1] * fu
    high = light[r + 1, c] * (1.0 - fu) + light[r + 1, c + 1] * fu
    return low * (1.0 - fv) + high * fv


@njit(cache=True, nogil=True, error_model="numpy")
def _mover_share(disc, x, y, footprint):  # type: ignore[no-untyped-def]
    """Share of a pixel that a moving thing covers: a box with rounded corners, edges one pixel soft."""
    dx, dy = x - disc[0], y - disc[1]
    p, q = abs(disc[2] * dx + disc[3] * dy), abs(disc[2] * dy - disc[3] * dx)
    corner = disc[7] * min(disc[4], disc[5])
    p, q = p - disc[4] + corner, q - disc[5] + corner
    outside = math.sqrt(max(p, 0.0) ** 2 + max(q, 0.0) ** 2) + min(max(p, q), 0.0) - corner
    return min(max(0.5 - outside / footprint, 0.0), 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _trace_row(hits, rays, R, centre, level_shift, z, light, blocks, frame, clouds, cloud):  # type: ignore[no-untyped-def]
    """hits (width, 4) of one image row: x, y on the ground, texture level (-1: sky, -2: no ray), light."""
    cloudy = clouds.size > 1
    flat = frame[5] - frame[4] < 1e-9
    texels_at_1m = 2.0**level_shift
    level, half = 0, 1.0
    for col in range(rays.shape[0]):
        x, y = rays[col, 0], rays[col, 1]
        hits[col, 2] = -2.0
        if math.isnan(x):
            continue
        dx = R[0, 0] * x + R[0, 1] * y + R[0, 2]
        dy = R[1, 0] * x + R[1, 1] * y + R[1, 2]
        dz = R[2, 0] * x + R[2, 1] * y + R[2, 2]
        if flat:
            t = (frame[5] - centre[2]) / dz if dz < -1e-3 else math.inf
        else:
            t = meet_ground(centre[0], centre[1], centre[2], dx, dy, dz, z, blocks, frame)
        hits[col, 2] = -1.0
        if not t < 1e6:
            continue
        gx, gy = centre[0] + t * dx, centre[1] + t * dy
        shade = 1.0 if flat else _grid_light(light, frame, gx, gy)
        if cloudy:
            shade *= _cloud_light(clouds, cloud, gx, gy)
        hits[col, 0], hits[col, 1], hits[col, 3] = gx, gy, shade
        # The texture level, linear between powers of two; found from the last pixel's, which is nearly always
        # the same.
        texels = max(t, 1e-3) * texels_at_1m
        while texels * half >= 2.0 and level < LEVELS - 2:
            level += 1
            half *= 0.5
        while texels * half < 1.0 and level > 0:
            level -= 1
            half *= 2.0
        hits[col, 2] = level + min(max(texels * half - 1.0, 0.0), 0.999)


@njit(cache=True, nogil=True, error_model="numpy")
def _sample_row(out, hits, step, pool, keys, table, last_used, clock, wanted, count):  # type: ignore[no-untyped-def]
    """Fill out (width, channels) from level floor(level) + step; step 0 starts the pixel, step 1 completes
    it.
    """
    seen_level, seen_i, seen_j, slot = -1, 0, 0, -1
    for col in range(out.shape[0]):
        level = int(hits[col, 2]) + step
        if hits[col, 2] < 0.0:
            continue
        share = hits[col, 2] - int(hits[col, 2])
        weight = np.float32(hits[col, 3] * (share if step else 1.0 - share) / 65535.0)
        su, sv = hits[col, 0] * _PER_METRE[level] - 0.5, hits[col, 1] * _PER_METRE[level] - 0.5
        u, v = math.floor(su), math.floor(sv)
        if (u >> 7) != seen_i or (v >> 7) != seen_j or level != seen_level:
            seen_i, seen_j, seen_level = u >> 7, v >> 7, level
            key = tile_key(level, seen_i, seen_j)
            slot = find_tile(key, keys, table)
            if slot < 0:
                count = _note(wanted, count, key)
            else:
                last_used[slot] = clock
        if slot < 0:
            continue
        fu, fv = np.float32(su - u), np.float32(sv - v)
        c, r = u & (TILE - 1), v & (TILE - 1)
        w11 = weight * fu * fv
        w10, w01 = weight * fv - w11, weight * fu - w11
        w00 = weight - w10 - w01 - w11
        for k in range(out.shape[1]):
            out[col, k] += (
                w00 * pool[slot, r, c, k] + w01 * pool[slot, r, c + 1, k]
                + w10 * pool[slot, r + 1, c, k] + w11 * pool[slot, r + 1, c + 1, k]
            )  # fmt: skip
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _overlay_row(out, hits, discs):  # type: ignore[no-untyped-def]
    """Sky, and moving things, over one image row."""
    for col in range(out.shape[0]):
        if hits[col, 2] == -1.0:
            out[col, :] = SKY
        if hits[col, 2] < 0.0:
            continue
        for m in range(discs.shape[0]):
            footprint = 1.0 / _PER_METRE[int(hits[col, 2])]
            cover = np.float32(_mover_share(discs[m], hits[col, 0], hits[col, 1], footprint))
            if cover <= 0.0:
                continue
            for k in range(out.shape[1]):
                if discs[m, 6] >= 0.0:
                    out[col, k] += cover * (np.float32(discs[m, 6] * hits[col, 3]) - out[col, k])
                else:
                    out[col, k] *= np.float32(1.0) + cover * np.float32(discs[m, 6])


@njit(cache=True, nogil=True, error_model="numpy")
def trace(  # type: ignore[no-untyped-def]
    hits, rays, rotations, centres, level_shift, z, light, blocks, frame, clouds, cloud
):
    """Fill hits (h, w, 4), see :func:`_trace_row`."""
    for row in range(rays.shape[0]):
        R, centre = rotations[row], centres[row]
        _trace_row(hits[row], rays[row], R, centre, level_shift, z, light, blocks, frame, clouds, cloud)


@njit(cache=True, nogil=True, error_model="numpy")
def sample(out, hits, discs, pool, keys, table, last_used, clock, wanted):  # type: ignore[no-untyped-def]
    """Fill out (h, w, channels), zeros, with radiance; returns how many tiles are missing: keys in wanted."""
    count = 0
    for row in range(hits.shape[0]):
        count = _sample_row(out[row], hits[row], 0, pool, keys, table, last_used, clock, wanted, count)
        count = _sample_row(out[row], hits[row], 1, pool, keys, table, last_used, clock, wanted, count)
        _overlay_row(out[row], hits[row], discs)
    return count
