// The limit of a training step: Gaussians to image and back by hand, everything kept in memory that is used again.
#include "limit_colors.h"
#include "limit_features.h"
#include "limit_harmonics.h"
#include "limit_lists.h"

namespace {

// What a tile leaves for its backward pass.
struct Tile {
  Lanes T[TILE];  // transmittance behind everything
  int32_t thread, batches;
  size_t end;     // of its masks or items among those of the thread
};

// What both passes share; `seconds` holds the stages' wall times, see STAGES in limit_training.py.
struct Workspace {
  Camera camera;
  Gaussians gaussians;
  int threads;
  Buffer<Splat> splats;    // [N], chunk by chunk without gaps
  Buffer<Group> groups;    // [N / 16]
  Buffer<int32_t> held, starts;  // [chunks], [chunks + 1]
  DepthOrder depth;
  TileLists lists;
  Buffer<Tile> tiles;
  Buffer<uint16_t> rows;                 // [I] see Record
  std::vector<std::vector<Mask>> masks;  // of every thread
  std::vector<std::vector<Item>> items;  // the same for features
  Buffer<std::atomic_flag> locks;        // [N]
  Buffer<FeatureScratch<4>> scratch;     // of every thread; with fewer slices its front is used
  Buffer<float> totals;    // [threads, N, 16]
  double seconds[9], clock;

  int chunks() const { return (gaussians.count + CHUNK - 1) / CHUNK; }
  int group_count() const { return (gaussians.count + 15) / 16; }
  Scene scene() const { return {camera.width, camera.height, lists.offsets.data, lists.ids.data, splats.data}; }
  void start() { clock = omp_get_wtime(); }
  void lap(int stage) {
    const double now = omp_get_wtime();
    seconds[stage] = now - clock, clock = now;
  }

  void project() {
    const int n = gaussians.count;
    splats.reserve(n), groups.reserve(group_count()), held.reserve(chunks()), starts.reserve(chunks() + 1);
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
    for (int c = 0; c < chunks(); c++) {
      int32_t next = CHUNK * c;
      for (int first = CHUNK * c; first < std::min(CHUNK * (c + 1), n); first += 16) {
        Group &group = groups[first / 16];
        group.first = next;
        group.visible = project_group(gaussians, camera, first, &splats[next]);
        next += __builtin_popcount(group.visible);
      }
      held[c] = next - CHUNK * c;
    }
    starts[0] = 0;
    for (int c = 0; c < chunks(); c++) starts[c + 1] = starts[c] + held[c];
  }

  void shade() {
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int i = 0; i < group_count(); i++)
      if (groups[i].visible) shade_group(gaussians, camera, 16 * i, groups[i], &splats[groups[i].first]);
  }

  void composite(float *rgb, float *alpha) {
    const Scene view = scene();
    tiles.reserve(view.tiles());
    rows.reserve(lists.offsets[view.tiles()]);
    masks.resize(threads);
#pragma omp parallel num_threads(threads)
    {
      const int thread = omp_get_thread_num();
      Record record = {rows.data, masks[thread], 0};
#pragma omp for schedule(dynamic, 4)
      for (int tile = 0; tile < view.tiles(); tile++) {
        composite_colors(view, tile, tiles[tile].T, &record, rgb, alpha);
        tiles[tile].thread = thread, tiles[tile].end = record.used;
      }
    }
  }

  template <int S> void composite_channels(const float *features, float *image, float *alpha) {
    const Scene view = scene();
    tiles.reserve(view.tiles());
    items.resize(threads), scratch.reserve(threads);
#pragma omp parallel num_threads(threads)
    {
      const int thread = omp_get_thread_num();
      auto &mine = (FeatureScratch<S> &)scratch[thread];
      size_t used = 0;
#pragma omp for schedule(dynamic, 4)
      for (int tile = 0; tile < view.tiles(); tile++) {
        Tile &t = tiles[tile];
        t.batches = composite_features<S>(view, tile, features, mine, t.T, items[thread], used, image, alpha);
        t.thread = thread, t.end = used;
      }
    }
  }

  // This thread's sums, zero for every splat.
  float *fresh_totals() {
    float *mine = totals.data + (size_t)16 * gaussians.count * omp_get_thread_num();
    for (int c = 0; c < chunks(); c++) std::memset(mine + (size_t)16 * CHUNK * c, 0, sizeof(float) * 16 * held[c]);
    return mine;
  }

  template <int S>
  void composite_channels_backward(const float *features, const float *v_image, const float *v_alpha,
                                   float *v_features) {
    const Scene view = scene();
    totals.reserve((size_t)16 * gaussians.count * threads), locks.reserve(gaussians.count);
#pragma omp parallel num_threads(threads)
    {
      auto &mine = (FeatureScratch<S> &)scratch[omp_get_thread_num()];
      float *sums = fresh_totals();
#pragma omp for schedule(static)
      for (int c = 0; c < chunks(); c++) {
        const int first = CHUNK * c, last = std::min(first + CHUNK, gaussians.count);
        std::memset(v_features + (size_t)16 * S * first, 0, sizeof(float) * 16 * S * (last - first));
      }
#pragma omp for schedule(dynamic, 4)
      for (int tile = 0; tile < view.tiles(); tile++) {
        const Tile &t = tiles[tile];
        composite_features_back<S>(view, tile, t.batches, t.T, items[t.thread].data() + t.end, features, v_image,
                                   v_alpha, mine, sums, v_features, locks.data);
      }
    }
  }

  void composite_backward(const float *v_rgb, const float *v_alpha) {
    const Scene view = scene();
    totals.reserve((size_t)16 * gaussians.count * threads);
#pragma omp parallel num_threads(threads)
    {
      float *mine = fresh_totals();
#pragma omp for schedule(dynamic, 4)
      for (int tile = 0; tile < view.tiles(); tile++) {
        const Mask *end = masks[tiles[tile].thread].data() + tiles[tile].end;
        walk_back(view, tile, tiles[tile].T, rows.data, end, v_rgb, v_alpha, mine);
      }
    }
  }

  void add_totals() {
    const size_t size = (size_t)16 * gaussians.count;
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int c = 0; c < chunks(); c++) {
      float *first = totals.data + (size_t)16 * CHUNK * c;
      for (int thread = 1; thread < threads; thread++)
        for (int i = 0; i < 16 * held[c]; i++) first[i] += first[size * thread + i];
    }
  }

  // Sums of the 16 Gaussians of a group, zero for the invisible: rows[q] holds sum q.
  void load_totals(int group, Lanes *rows) {
    const float *total = totals.data + (size_t)16 * groups[group].first;
    for (int i = 0; i < 16; i++) {
      const bool visible = groups[group].visible >> i & 1;
      rows[i] = load_if(visible, total), total += 16 * visible;
    }
    transpose(rows);
  }

  void project_backward(float *v_means, float *v_quats, float *v_scales, float *v_opacities) {
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int group = 0; group < group_count(); group++) {
      Lanes rows[16];
      load_totals(group, rows);
      project_group_backward(gaussians, camera, 16 * group, groups[group].visible, rows, v_means, v_quats, v_scales,
                             v_opacities);
    }
  }

  void shade_backward(float *v_means, float *v_sh) {
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int group = 0; group < group_count(); group++) {
      Lanes rows[16];
      load_totals(group, rows);
      shade_group_backward(gaussians, camera, 16 * group, groups[group], rows + 6, v_means, v_sh);
    }
  }
};

}  // namespace

extern "C" Workspace *workspace_new() { return new Workspace(); }

extern "C" void workspace_delete(Workspace *workspace) { delete workspace; }

// values [N, 16, 3] are coefficients where channels is 3, else features [N, channels], channels 16 or 64. image [H, W,
// channels], alpha [H, W]. The arrays stay where they are until the backward pass. Returns the number of intersections.
extern "C" int forward(Workspace *w, const Camera *camera, int count, const float *means, const float *quats,
                       const float *scales, const float *opacities, const float *values, int channels, int threads,
                       float *image, float *alpha) {
  w->camera = *camera;
  w->gaussians = {count, means, quats, scales, opacities, values};
  w->threads = threads;
  w->start();
  w->project(), w->lap(0);
  w->depth.sort(w->splats.data, w->held.data, w->starts.data, w->chunks(), threads), w->lap(1);
  if (channels == 3) w->shade();
  w->lap(2);
  const int visible = w->starts[w->chunks()], width = camera->width, height = camera->height;
  const int total = w->lists.build(w->splats.data, w->depth.order.data, visible, width, height, threads);
  w->lap(3);
  if (channels == 3) w->composite(image, alpha);
  if (channels == 16) w->composite_channels<1>(values, image, alpha);
  if (channels == 64) w->composite_channels<4>(values, image, alpha);
  w->lap(4);
  return total;
}

// Of the last forward pass: v_image [H, W, channels] and v_alpha [H, W] to the gradients of everything. v_values is
// aligned to 64 bytes.
extern "C" void backward(Workspace *w, const float *v_image, const float *v_alpha, int channels, float *v_means,
                         float *v_quats, float *v_scales, float *v_opacities, float *v_values) {
  const float *values = w->gaussians.values;
  w->start();
  if (channels == 3) w->composite_backward(v_image, v_alpha);
  if (channels == 16) w->composite_channels_backward<1>(values, v_image, v_alpha, v_values);
  if (channels == 64) w->composite_channels_backward<4>(values, v_image, v_alpha, v_values);
  w->lap(5);
  w->add_totals(), w->lap(6);
  w->project_backward(v_means, v_quats, v_scales, v_opacities), w->lap(7);
  if (channels == 3) w->shade_backward(v_means, v_values);
  w->lap(8);
}

// Wall times of the last passes' nine stages.
extern "C" void stage_seconds(const Workspace *w, double *seconds) {
  std::memcpy(seconds, w->seconds, sizeof w->seconds);
}
