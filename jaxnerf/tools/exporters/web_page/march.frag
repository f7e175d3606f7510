#version 300 es
// Renders one pixel of a hash grid through its occupancy grid. exporters/web.py replaces the lines that begin with
// "//@" by constants and functions of one scene. The arithmetic follows core/occupancy/ray_marching.py (where samples
// are), core/occupancy/packed.py (early termination), fields/hash_grid.py (what is evaluated there) and, for forward-facing
// scenes, core/cameras.py (normalised device coordinates).
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

//@constants

uniform vec3 eye;          // world units
uniform mat3 turn;         // camera's axes (right, up, back) to world
uniform vec2 focal;        // px of this image
uniform vec2 center;       // px
uniform float image_height;  // px
uniform float near, far;   // in t, the distance along the camera's axis; not used in NDC
uniform vec2 ndc_scale;    // 2 focal / size of the lens that defines NDC; used in NDC only
uniform int shown;         // 0: colour, 1: depth, 2: normals
uniform vec2 depth_range;  // in t, drawn black and white

uniform sampler2D table;       // vertices' features, 4 in a texel, LEVEL after LEVEL
uniform sampler2D weights;     // of the networks, see web.py
uniform usampler2D occupied;   // a bit for each cell, z fastest, 32 in a texel
uniform usampler2D coarse;     // a bit for each cube of COARSE^3 cells: whether any of them is occupied

out vec4 color;

vec4 weight(int index) {
  return texelFetch(weights, ivec2(index % WEIGHTS_WIDTH, index / WEIGHTS_WIDTH), 0);
}

vec4 features_of(int row, int group, float scale, float shift) {
  int index = row * GROUPS + group;
  return texelFetch(table, ivec2(index % TABLE_WIDTH, index / TABLE_WIDTH), 0) * scale + shift;
}

bool bit_of(usampler2D bits, int index) {
  int word = index >> 5;
  return ((texelFetch(bits, ivec2(word % BITS_WIDTH, word / BITS_WIDTH), 0).r >> uint(index & 31)) & 1u) == 1u;
}

// Interpolates a group of 4 features of a level between the 8 vertices around a place in the box, in [0, 1]^3.
vec4 interpolated(vec3 place, ivec3 size, int start, uint rows, bool hashed, int group, float scale, float shift) {
  vec3 spread = clamp(place, 0.0, 1.0) * vec3(size - 1);
  ivec3 low = min(ivec3(spread), size - 2);
  vec3 fraction = spread - vec3(low);
  vec4 sum = vec4(0.0);
  for (int corner = 0; corner < 8; ++corner) {
    ivec3 offset = ivec3(corner >> 2, (corner >> 1) & 1, corner & 1);
    ivec3 vertex = low + offset;
    int row;
    if (hashed) {
      uvec3 v = uvec3(vertex) * uvec3(1u, 2654435761u, 805459861u);
      row = int((v.x ^ v.y ^ v.z) % rows);
    } else {
      row = (vertex.x * size.y + vertex.y) * size.z + vertex.z;
    }
    vec3 part = mix(1.0 - fraction, fraction, vec3(offset));
    sum += part.x * part.y * part.z * features_of(start + row, group, scale, shift);
  }
  return sum;
}

// The spherical harmonics of degree up to 2, padded to 12.
void harmonics(vec3 v, out vec4 y[3]) {
  y[0] = vec4(0.28209479, 0.48860251 * v.y, 0.48860251 * v.z, 0.48860251 * v.x);
  y[1] = vec4(1.0925484 * v.x * v.y, 1.0925484 * v.y * v.z, 1.0925484 * v.x * v.z,
              0.31539157 * (3.0 * v.z * v.z - 1.0));
  y[2] = vec4(0.54627421 * (v.x * v.x - v.y * v.y), 0.0, 0.0, 0.0);
}

// All of space into [-2, 2]^3, see core/contraction.py.
vec3 contract(vec3 x) {
  x = clamp(x, -1e30, 1e30);
  float largest = max(max(abs(x.x), abs(x.y)), abs(x.z));
  float safe = max(largest, 1.0);
  return largest > 1.0 ? x / safe * (2.0 - 1.0 / safe) : x;
}

//@field

// The ray of the pixel: origin + t * direction for t from first to last, world units, or NDC.
vec3 origin;
float first, last;

// Returns the direction of the ray in the coordinates of the field; toward: in the world, to the plane at distance 1.
vec3 prepare_line(vec3 toward) {
#if NDC
  bool forward = toward.z < -1e-6;  // NDC hold nothing of rays that point backwards
  vec2 slant = toward.xy / (forward ? toward.z : -1.0);
  origin = vec3(ndc_scale * (eye.xy - (1.0 + eye.z) * slant), -1.0);
  first = 1.0 - 1.0 / max(-eye.z, 1.0);  // an eye beyond the near plane does not see what is behind it
  last = forward ? 1.0 : first;
  return vec3(ndc_scale * (eye.z * slant - eye.xy), 2.0);
#else
  origin = eye;
  first = near;
  last = far;
  return toward;
#endif
}

// Where the rays of a pixel have their samples: edge k is at t = edge(k), and the last at t_far.
float t_near, t_far, t_step;
#if CONTRACTED
float t_nearest, t_scale, s_near, s_far;

float compressed(float t) {
  float ratio = clamp(t / t_scale, -1e15, 1e15);
  return 2.0 * ratio * t_scale / (1.0 + sqrt(1.0 + 4.0 * ratio * ratio));
}

void place_samples(vec3 direction) {
  vec3 middle = 0.5 * (LOWER + UPPER), side = UPPER - LOWER;
  float half_side = 0.5 * max(max(side.x, side.y), side.z);
  float squares = dot(direction, direction);
  t_nearest = dot(middle - origin, direction) / squares;
  vec3 away = origin + t_nearest * direction - middle;
  float smallest = half_side / sqrt(squares);
  t_scale = max(sqrt(dot(away, away) / squares), smallest);
  t_near = first;
  t_far = last;
  t_step = STEP / sqrt(squares) * t_scale / smallest;
  float s_last = t_scale - 0.5 * t_step;
  s_near = min(compressed(first - t_nearest), s_last);
  s_far = min(compressed(last - t_nearest), s_last);
}

float edge(int k) {
  float s = min(s_near + float(k) * t_step, s_far);
  float ratio = s / t_scale;
  return clamp(t_nearest + s / (1.0 - ratio * ratio), t_near, t_far);
}

bool ended(int k) { return s_near + float(k) * t_step >= s_far; }

int segment_before(float t) { return int((compressed(t - t_nearest) - s_near) / t_step - 1.0); }
#else
void place_samples(vec3 direction) {
  bvec3 level = equal(direction, vec3(0.0));
  vec3 safe = mix(direction, vec3(1.0), vec3(level));
  vec3 low = (LOWER - origin) / safe, high = (UPPER - origin) / safe;
  vec3 enter = min(low, high), leave = max(low, high);
  for (int axis = 0; axis < 3; ++axis) {
    if (level[axis]) {
      enter[axis] = origin[axis] >= LOWER[axis] && origin[axis] < UPPER[axis] ? -1e30 : 1e30;
      leave[axis] = 1e30;
    }
  }
  t_near = clamp(max(max(enter.x, enter.y), enter.z), first, last);
  t_far = clamp(min(min(leave.x, leave.y), leave.z), t_near, last);
  t_step = STEP / length(direction);
}

float edge(int k) { return min(t_near + float(k) * t_step, t_far); }

bool ended(int k) { return t_near + float(k) * t_step >= t_far; }

int segment_before(float t) { return int((t - t_near) / t_step - 1.0); }
#endif

// Returns whether the cell around a point is occupied; if a cube of cells around it is empty, skip_to is the t at
// which the ray leaves the cube.
bool is_occupied(vec3 direction, float t, out float skip_to) {
  skip_to = -1e30;
  vec3 per_unit = vec3(CELLS) / (UPPER - LOWER);
  vec3 place = (origin - LOWER) * per_unit + t * (direction * per_unit);
  bool straight = true;  // whether the ray is straight in the coordinates of the cells
#if CONTRACTED
  vec3 along = place * (4.0 / vec3(CELLS)) - 2.0;
  straight = max(max(abs(along.x), abs(along.y)), abs(along.z)) < 1.0;
  place = (min(contract(along), 2.0 - 1e-6) + 2.0) * (vec3(CELLS) / 4.0);
#endif
  ivec3 cell = ivec3(floor(place));
  if (any(lessThan(cell, ivec3(0))) || any(greaterThanEqual(cell, CELLS))) return false;
  ivec3 cube = cell / COARSE;
  if (!bit_of(coarse, (cube.x * CUBES.y + cube.y) * CUBES.z + cube.z)) {
    if (straight) {
      vec3 low = vec3(cube * COARSE), high = low + float(COARSE);
#if CONTRACTED
      low = max(low, 0.25 * vec3(CELLS));
      high = min(high, 0.75 * vec3(CELLS));
#endif
      vec3 pace = direction * per_unit;
      vec3 exits = (mix(low, high, greaterThan(pace, vec3(0.0))) - place) / mix(pace, vec3(1e-30), equal(pace, vec3(0.0)));
      exits = mix(exits, vec3(1e30), equal(pace, vec3(0.0)));
      skip_to = t + min(min(exits.x, exits.y), exits.z);
    }
    return false;
  }
  return bit_of(occupied, (cell.x * CELLS.y + cell.y) * CELLS.z + cell.z);
}

// From blue (near) over green to red (far).
vec3 depth_color(float value) {
  return clamp(1.5 - abs(4.0 * value - vec3(3.0, 2.0, 1.0)), 0.0, 1.0);
}

void main() {
  vec2 pixel = vec2(gl_FragCoord.x, image_height - gl_FragCoord.y);  // y down, centres at .5
  vec2 plane = (pixel - center) / focal;
  vec3 toward = turn * vec3(plane.x, -plane.y, -1.0);
  vec3 direction = prepare_line(toward);
  float speed = length(direction);
  place_samples(direction);
  prepare_ray(normalize(toward));
  float transmittance = 1.0, opacity = 0.0, depth = 0.0;
  vec3 rgb = vec3(0.0);
  bool opaque = false;
  int evaluated = 0;
  for (int k = 0; k < MAX_SEGMENTS && !ended(k); ++k) {
    float low = edge(k), high = edge(k + 1), t = 0.5 * (low + high), skip_to;
    if (high <= low) continue;
    if (!is_occupied(direction, t, skip_to)) {
      if (skip_to > t) k = max(k, segment_before(skip_to));
      continue;
    }
    float density;
    vec3 emitted;
    evaluate(origin + t * direction, density, emitted);
    float through = exp(-density * (high - low) * speed);
    float part = transmittance * (1.0 - through);
    rgb += part * emitted;
    depth += part * t;
    opacity += part;
    transmittance *= through;
    // The renderer of jaxnerf tests after each group of samples.
    if (++evaluated % GROUP == 0 && transmittance <= EARLY_STOP_EPS) {
      opaque = true;
      break;
    }
  }
  if (evaluated % GROUP != 0 && transmittance <= EARLY_STOP_EPS) opaque = true;
  if (opaque && opacity > 0.0) {  // the remaining light is assumed to look like the rest of the ray
    rgb /= opacity;
    depth /= opacity;
    opacity = 1.0;
    transmittance = 0.0;
  }
#if NDC
  depth = opacity > 0.0 ? depth / opacity : 1.0;  // the light that is left comes from infinity
  depth = -(1.0 + eye.z + depth / max(1.0 - depth, 1e-6)) / min(toward.z, -1e-6);
#else
  depth += transmittance * t_far;
#endif
  if (shown == 0) {
    color = vec4(rgb + transmittance * BACKGROUND, 1.0);
  } else if (shown == 1) {
    float value = clamp((depth - depth_range.x) / (depth_range.y - depth_range.x), 0.0, 1.0);
    color = vec4(mix(depth_color(value), vec3(1.0), transmittance), 1.0);
  } else {
    vec3 point = eye + depth * toward;
    vec3 normal = cross(dFdx(point), dFdy(point));
    normal = dot(normal, normal) > 0.0 ? normalize(normal) : vec3(0.0);
    color = vec4(mix(0.5 + 0.5 * normal, vec3(1.0), transmittance), 1.0);
  }
}
