// A plain ray caster over one 8-bit array: scalar, no skipping, threads by OpenMP; what a careful programmer writes in an hour.
// It draws the ripples of `cargo run --release -p chronoxel-render --example turntable -- ripples 256`, with `filled`, the same
// camera, picture and step, and stops rays at a transmittance of 1/512 as that does.
//
//     gcc -O3 -march=native -ffast-math -fopenmp naive.c -o naive -lm && ./naive 256
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

enum { SIZE = 512, FRAMES = 24 };
typedef struct { float x, y, z; } vec;

static vec add(vec a, vec b, float k) { return (vec){a.x + k * b.x, a.y + k * b.y, a.z + k * b.z}; }
static float bump(float s, float centre, float width) { return expf(-powf((s - centre) / width, 2)); }

static double cpu_seconds(void) {
    struct timespec t;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

// Shortens [*enter, *leave] to where one coordinate of a ray lies in [0, top].
static void clip(float from, float step, float top, float *enter, float *leave) {
    if (fabsf(step) < 1e-12f) step = 1e-12f;
    float a = -from / step, b = (top - from) / step;
    *enter = fmaxf(*enter, fminf(a, b));
    *leave = fminf(*leave, fmaxf(a, b));
}

int main(int argc, char **argv) {
    int n = argc > 1 ? atoi(argv[1]) : 256;
    size_t row = n, slice = (size_t)n * n;
    uint8_t *volume = calloc(slice * n + slice + row + 2, 1);
    for (int k = 0; k < n; k++)
        for (int j = 0; j < n; j++)
            for (int i = 0; i < n; i++) {
                double a = (i - n / 2.) / n, b = (j - n / 2.) / n, c = (k - n / 2.) / n, r = sqrt(a * a + b * b + c * c);
                volume[k * slice + j * row + i] = 127 + 127 * sin(40 * r + 6 * a * sin(9 * b)) * exp(-2 * r);
            }
    float table[256][4]; // premultiplied, for steps of half a voxel
    for (int i = 0; i < 256; i++) {
        float s = i / 255.f;
        float opacity = .006f + .02f * s + .04f * bump(s, .75f, .05f) + .02f * bump(s, .2f, .04f);
        float alpha = 1 - sqrtf(1 - opacity);
        float color[3] = {s, .2f + .6f * bump(s, .5f, .2f), 1 - s};
        for (int c = 0; c < 3; c++) table[i][c] = color[c] * alpha;
        table[i][3] = alpha;
    }
    float (*picture)[4] = calloc(SIZE * SIZE, sizeof *picture);
    long long samples = 0;
    double start = cpu_seconds();
    for (int frame = 0; frame < FRAMES; frame++) {
        float azimuth = frame * 2 * M_PI / FRAMES, elevation = 20 * M_PI / 180, half = tanf(15 * M_PI / 180);
        vec out = {sinf(azimuth) * cosf(elevation), sinf(elevation), cosf(azimuth) * cosf(elevation)};
        vec right = {cosf(azimuth), 0, -sinf(azimuth)};
        vec up = {-sinf(azimuth) * sinf(elevation), cosf(elevation), -cosf(azimuth) * sinf(elevation)};
        float centre = (n - 1) / 2.f;
        vec eye = add((vec){centre, centre, centre}, out, 4.0561f * n);
#pragma omp parallel for schedule(dynamic, 8) reduction(+ : samples)
        for (int y = 0; y < SIZE; y++)
            for (int x = 0; x < SIZE; x++) {
                vec ray = add(add((vec){-out.x, -out.y, -out.z}, right, half * (2 * (x + .5f) / SIZE - 1)), up,
                              half * (1 - 2 * (y + .5f) / SIZE));
                float scale = .5f / sqrtf(ray.x * ray.x + ray.y * ray.y + ray.z * ray.z);
                vec step = {ray.x * scale, ray.y * scale, ray.z * scale};
                float enter = 0, leave = 1e9f, gathered[4] = {0, 0, 0, 1};
                clip(eye.x, step.x, n - 1, &enter, &leave);
                clip(eye.y, step.y, n - 1, &enter, &leave);
                clip(eye.z, step.z, n - 1, &enter, &leave);
                int count = leave > enter ? (int)(leave - enter + .5f) : 0, k = 0;
                vec p = add(eye, step, enter + .5f);
                for (; k < count && gathered[3] > 1 / 512.f; k++, p = add(p, step, 1)) {
                    int i = p.x, j = p.y, l = p.z;
                    float u = p.x - i, v = p.y - j, w = p.z - l;
                    const uint8_t *a = volume + l * slice + j * row + i, *b = a + slice;
                    float a0 = a[0] + u * (a[1] - a[0]), a1 = a[row] + u * (a[row + 1] - a[row]);
                    float b0 = b[0] + u * (b[1] - b[0]), b1 = b[row] + u * (b[row + 1] - b[row]);
                    float near = a0 + v * (a1 - a0), far = b0 + v * (b1 - b0);
                    const float *sample = table[(int)(near + w * (far - near) + .5f)];
                    for (int c = 0; c < 3; c++) gathered[c] += gathered[3] * sample[c];
                    gathered[3] *= 1 - sample[3];
                }
                samples += k;
                for (int c = 0; c < 4; c++) picture[y * SIZE + x][c] = gathered[c];
            }
    }
    double seconds = cpu_seconds() - start;
    printf("%d^3 filled: CPU ms per frame %.1f; %.1f M samples per frame, %.1f M samples per CPU second\n", n,
           seconds * 1e3 / FRAMES, samples / 1e6 / FRAMES, samples / 1e6 / seconds);
    free(picture);
    free(volume);
    return 0;
}
