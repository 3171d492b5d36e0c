// The density of a radiance field, written by hand for one machine: what the kernels of Dr.Jit are measured against.
//
// Points go in packets of 16 lanes, four packets at once through the network, so that each weight is read once for 64
// points; the two features of a vertex are one load of eight bytes. Beside it are the loops that say what the machine
// can do: products and sums a second, bytes a second, and loads of eight bytes a second at random places.
//
// Built, with its options, and called by density_limit.py.

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <cstring>
#include <thread>
#include <vector>
#ifdef __SSE2__
#include <immintrin.h>
#endif

namespace {

constexpr int LANES = 16, PACKETS = 4, BLOCK = LANES * PACKETS, ROWS = 4, MOST = 64;
constexpr long CHUNK = 64 * BLOCK;
typedef float Floats __attribute__((vector_size(64)));
typedef uint32_t Words __attribute__((vector_size(64)));

// A vector that fills one register, and the letter by which inline assembly names such a register.
#if defined __AVX512F__
typedef Floats Register;
#elif defined __AVX__
typedef float Register __attribute__((vector_size(32)));
#else
typedef float Register __attribute__((vector_size(16)));
#endif
#ifdef __aarch64__
#define IN_REGISTER "+w"
#else
#define IN_REGISTER "+v"
#endif

struct Field {
    const float *table, *hidden, *head;  // rows of two features; (width, inputs); (width,)
    const float *scales;                 // of each level
    const uint32_t *offsets, *rows, *strides;  // in rows; a stride of 0: hashed
    int32_t levels, width;
    float lower[3], inverse_side, density_scale;
};

inline Floats all(float x) { return x - (Floats){}; }

inline Floats load(const float *from) {
    Floats out;
    std::memcpy(&out, from, sizeof out);
    return out;
}

// The pairs of floats in the rows `index` of `table`, as two packets.
inline void pairs(const float *table, Words index, Floats &first, Floats &second) {
#ifdef __AVX512F__
    __m512i parts[2];
    for (int half = 0; half < 2; ++half) {
        __m256i quarter[2];
        for (int k = 0; k < 2; ++k) {
            const int at = 8 * half + 4 * k;
            auto row = [&](int lane) { return (const double *)(table + 2 * (size_t)index[at + lane]); };
            const __m128d low = _mm_loadh_pd(_mm_load_sd(row(0)), row(1));
            const __m128d high = _mm_loadh_pd(_mm_load_sd(row(2)), row(3));
            quarter[k] = _mm256_castpd_si256(_mm256_insertf128_pd(_mm256_castpd128_pd256(low), high, 1));
        }
        parts[half] = _mm512_inserti64x4(_mm512_castsi256_si512(quarter[0]), quarter[1], 1);
    }
    const __m512i even = _mm512_set_epi32(30, 28, 26, 24, 22, 20, 18, 16, 14, 12, 10, 8, 6, 4, 2, 0);
    const __m512 low = _mm512_castsi512_ps(parts[0]), high = _mm512_castsi512_ps(parts[1]);
    first = (Floats)_mm512_permutex2var_ps(low, even, high);
    second = (Floats)_mm512_permutex2var_ps(low, _mm512_add_epi32(even, _mm512_set1_epi32(1)), high);
#else
    for (int lane = 0; lane < LANES; ++lane) {
        first[lane] = table[2 * (size_t)index[lane]];
        second[lane] = table[2 * (size_t)index[lane] + 1];
    }
#endif
}

// exp(x) for |x| < 87, to rounding (Cephes).
inline Floats exponential(Floats x) {
    const Floats scaled = x * 1.44269504f;
    const Words integer = __builtin_convertvector(scaled + 128.5f, Words);  // rounded, of what is positive
    const Floats n = __builtin_convertvector(integer, Floats) - 128.0f;
    const Floats r = (x - n * 0.693359375f) + n * 2.12194440e-4f;
    Floats p = all(1.9875691500e-4f);
    for (float c : {1.3981999507e-3f, 8.3334519073e-3f, 4.1665795894e-2f, 1.6666665459e-1f, 5.0000001201e-1f})
        p = p * r + c;
    const Words power = (integer - 1) << 23;  // 2^n
    return (p * r * r + r + 1.0f) * (Floats)power;
}

// Densities of 64 points inside of the box.
void block(const Field &f, const float *const p[3], float *out) {
    Floats inputs[2 * 32][PACKETS];
    for (int packet = 0; packet < PACKETS; ++packet) {
        Floats u[3];
        for (int axis = 0; axis < 3; ++axis)
            u[axis] = (load(p[axis] + packet * LANES) - f.lower[axis]) * f.inverse_side;
        for (int level = 0; level < f.levels; ++level) {
            const uint32_t stride = f.strides[level];
            const uint32_t steps[3] = {1, stride ? stride : 2654435761u, stride ? stride * stride : 805459861u};
            Words ends[3][2];
            Floats w[3];
            for (int axis = 0; axis < 3; ++axis) {
                const Floats x = u[axis] * f.scales[level] + 0.5f;
                const Words cell = __builtin_convertvector(x, Words);
                w[axis] = x - __builtin_convertvector(cell, Floats);
                ends[axis][0] = cell * steps[axis];
                ends[axis][1] = ends[axis][0] + steps[axis];
            }
            const float *table = f.table + 2 * (size_t)f.offsets[level];
            Floats value[2][4];
            for (int yz = 0; yz < 4; ++yz) {
                const Words y = ends[1][yz & 1], z = ends[2][yz >> 1];
                Floats end[2][2];
                for (int x = 0; x < 2; ++x) {
                    const Words row = stride ? ends[0][x] + y + z : (ends[0][x] ^ y ^ z) & (f.rows[level] - 1);
                    pairs(table, row, end[0][x], end[1][x]);
                }
                for (int k = 0; k < 2; ++k) value[k][yz] = end[k][0] + (end[k][1] - end[k][0]) * w[0];
            }
            for (int k = 0; k < 2; ++k) {
                const Floats low = value[k][0] + (value[k][1] - value[k][0]) * w[1];
                const Floats high = value[k][2] + (value[k][3] - value[k][2]) * w[1];
                inputs[2 * level + k][packet] = low + (high - low) * w[2];
            }
        }
    }
    Floats sum[PACKETS] = {};
    const int count = 2 * f.levels;
    for (int j = 0; j < f.width; j += ROWS) {
        Floats hidden[ROWS][PACKETS] = {};
        for (int i = 0; i < count; ++i)
            for (int row = 0; row < ROWS; ++row) {
                const Floats weight = all(f.hidden[(j + row) * count + i]);
                for (int packet = 0; packet < PACKETS; ++packet) hidden[row][packet] += weight * inputs[i][packet];
            }
        for (int row = 0; row < ROWS; ++row)
            for (int packet = 0; packet < PACKETS; ++packet) {
                const Floats h = hidden[row][packet];
                sum[packet] += (h > 0 ? h : (Floats){}) * f.head[j + row];
            }
    }
    for (int packet = 0; packet < PACKETS; ++packet) {
        Floats h = sum[packet];
        h = h < 30.0f ? h : all(30.0f);
        h = h > -87.0f ? h : all(-87.0f);
        const Floats density = exponential(h) * f.density_scale;
        std::memcpy(out + packet * LANES, &density, sizeof density);
    }
}

// Layers without biases, ReLU between them; sizes after the first are multiples of ROWS.
struct Network {
    const float *weights[4];  // of each layer (outputs, inputs)
    int32_t sizes[5], layers;
};

// Outputs of 64 points, at `at` of `count`, from their inputs; a row of `count` numbers for each.
void block(const Network &n, const float *in, float *out, int64_t at, int64_t count) {
    Floats values[2][MOST][PACKETS];
    for (int i = 0; i < n.sizes[0]; ++i)
        for (int packet = 0; packet < PACKETS; ++packet) values[0][i][packet] = load(in + i * count + at + packet * LANES);
    for (int layer = 0; layer < n.layers; ++layer) {
        const int inputs = n.sizes[layer], outputs = n.sizes[layer + 1];
        const auto &from = values[layer & 1];
        auto &to = values[~layer & 1];
        const bool last = layer + 1 == n.layers;
        for (int j = 0; j < outputs; j += ROWS) {
            Floats sums[ROWS][PACKETS] = {};
            for (int i = 0; i < inputs; ++i)
                for (int row = 0; row < ROWS; ++row) {
                    const Floats weight = all(n.weights[layer][(j + row) * inputs + i]);
                    for (int packet = 0; packet < PACKETS; ++packet) sums[row][packet] += weight * from[i][packet];
                }
            for (int row = 0; row < ROWS; ++row)
                for (int packet = 0; packet < PACKETS; ++packet) {
                    const Floats h = sums[row][packet];
                    to[j + row][packet] = last ? h : h > 0 ? h : (Floats){};
                }
        }
    }
    for (int j = 0; j < n.sizes[n.layers]; ++j)
        for (int packet = 0; packet < PACKETS; ++packet)
            std::memcpy(out + j * count + at + packet * LANES, &values[n.layers & 1][j][packet], sizeof(Floats));
}

// Takes the smallest numbers for 0 while it lives, as Dr.Jit's threads do: they are slow.
struct Flushing {
#ifdef __SSE2__
    unsigned before = _mm_getcsr();
    Flushing() { _mm_setcsr(before | 0x8040); }
    ~Flushing() { _mm_setcsr(before); }
#endif
};

template <typename Work> void on_threads(int threads, Work given) {
    auto work = [&](int thread) {
        Flushing flushing;
        given(thread);
    };
    std::vector<std::thread> others;
    for (int k = 1; k < threads; ++k) others.emplace_back(work, k);
    work(0);
    for (auto &other : others) other.join();
}

}  // namespace

extern "C" {

// Densities of `count` points, a multiple of 64, on so many threads. Returns 0, or 1 for a field that it does not know.
int densities(const Field *f, const float *x, const float *y, const float *z, float *out, int64_t count, int threads) {
    if (f->levels > 32 || f->width > MOST || f->width % ROWS || count % BLOCK) return 1;
    std::atomic<int64_t> next{0};
    on_threads(threads, [&](int) {
        for (int64_t at; (at = next.fetch_add(CHUNK)) < count;)
            for (int64_t k = at; k < std::min<int64_t>(at + CHUNK, count); k += BLOCK) {
                const float *const p[3] = {x + k, y + k, z + k};
                block(*f, p, out + k);
            }
    });
    return 0;
}

// Outputs of `count` points, a multiple of 64, on so many threads. Returns 0, or 1 for a network that it does not know.
int network(const Network *n, const float *in, float *out, int64_t count, int threads) {
    if (n->layers < 1 || n->layers > 4 || n->sizes[0] > MOST || count % BLOCK) return 1;
    for (int layer = 1; layer <= n->layers; ++layer)
        if (n->sizes[layer] > MOST || n->sizes[layer] % ROWS) return 1;
    std::atomic<int64_t> next{0};
    on_threads(threads, [&](int) {
        for (int64_t at; (at = next.fetch_add(CHUNK)) < count;)
            for (int64_t k = at; k < std::min<int64_t>(at + CHUNK, count); k += BLOCK) block(*n, in, out, k, count);
    });
    return 0;
}

// Products with sums, `rounds` times 12 packets a thread, in registers: 2 * 16 * 12 operations a round and thread.
float peak_products(int64_t rounds, int threads) {
    std::vector<float> found(threads);
    on_threads(threads, [&](int thread) {
        Register sums[12], a = 0.999999f - (Register){}, b = 1e-7f - (Register){};
        for (int k = 0; k < 12; ++k) sums[k] = 1e-3f * (k + thread) - (Register){};
        for (int64_t round = 0; round < rounds * int64_t(sizeof(Floats) / sizeof(Register)); ++round) {
#pragma GCC unroll 12
            for (int k = 0; k < 12; ++k) sums[k] = sums[k] * a + b;
            asm volatile("" : IN_REGISTER(a), IN_REGISTER(b));  // so that rounds are not merged
        }
        for (int k = 0; k < 12; ++k) found[thread] += sums[k][0];
    });
    float sum = 0;
    for (float value : found) sum += value;
    return sum;
}

// Sum of `values` (`count` floats), read `rounds` times; every thread reads all of a table, or its share of memory.
float peak_reads(const float *values, int64_t count, int64_t rounds, int shared, int threads) {
    std::vector<float> found(threads);
    on_threads(threads, [&](int thread) {
        const int64_t part = shared ? count : count / threads / (8 * LANES) * (8 * LANES);
        const float *from = values + (shared ? 0 : thread * part);
        Floats sums[8] = {};
        for (int64_t round = 0; round < rounds; ++round) {
            for (int64_t at = 0; at + 8 * LANES <= part; at += 8 * LANES)
#pragma GCC unroll 8
                for (int k = 0; k < 8; ++k) sums[k] += load(from + at + k * LANES);
            asm volatile("" ::: "memory");
        }
        for (auto &sum : sums) found[thread] += sum[0];
    });
    float sum = 0;
    for (float value : found) sum += value;
    return sum;
}

// Loads of pairs at random rows of a table of `rows`, a power of two: 16 * `rounds` a thread.
float peak_pairs(const float *table, uint32_t rows, int64_t rounds, int threads) {
    std::vector<float> found(threads);
    on_threads(threads, [&](int thread) {
        Words index;
        for (int lane = 0; lane < LANES; ++lane) index[lane] = 2654435761u * (lane + 1 + LANES * thread);
        Floats sums[2] = {};
        for (int64_t round = 0; round < rounds; ++round) {
            index = index * 1664525u + 1013904223u;
            Floats a, b;
            pairs(table, (index >> 8) & (rows - 1), a, b);
            sums[0] += a;
            sums[1] += b;
        }
        found[thread] = sums[0][0] + sums[1][0];
    });
    float sum = 0;
    for (float value : found) sum += value;
    return sum;
}

}
