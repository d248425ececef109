// The pixels of the viewer: where each looks, what is there, and in which colors that is shown. With
// POINTS: the points of the distances; VERTEX: their places and sizes.
// Positions in an image are u to the right and v down, 0 to 1; longitude 0 is u = 1/2, the north
// pole v = 0. Axes: ahead, right, up.
precision highp float;
precision highp int;
precision highp sampler2D;

const float PI = 3.14159265358979;
const float UNKNOWN = -1e9;
const float WORST = 0.22314355;  // ln 1.25
const int REACH = 2;  // pixels between neighbors that tell which way a surface faces
const float STEEP = 12.0;  // slope of a surface, seen from the center, of 85 degrees
const int INSIDE = 0, PLANET = 1, FLAT = 2;
const int INPUT = 0, TRUTH = 1, PREDICTION = 2, ERROR = 3, OVERLAY = 4,
    CONFIDENCE = 5;
const vec3 OUTSIDE = vec3(0.086, 0.094, 0.11);
const vec3 WRONG = vec3(214.0, 39.0, 40.0) / 255.0, UNLABELED = vec3(136.0 / 255.0);
const vec3 UNSURE = vec3(94.0, 60.0, 153.0) / 255.0;
// Four samples in a turned square: class borders without steps.
const vec2 OFFSETS[4] =
    vec2[](vec2(-0.125, -0.375), vec2(0.375, -0.125), vec2(0.125, 0.375), vec2(-0.375, 0.125));

uniform sampler2D uInput, uTruth, uPrediction, uConfidence;
uniform sampler2D uColors;    // of the classes, alpha 0: hidden; or from near to far
uniform vec4 uScale;          // logarithms of the distances: nearest, farthest, first, last color
uniform vec2 uCanvas;         // pixels
uniform vec2 uCenter;         // u, v in the middle of the canvas
uniform float uReach;         // tangent plane, stereographic plane or u at half the longer side
uniform float uAspect;        // width of the image over its height
uniform float uOpacity;
uniform float uSwipe;         // share of the canvas that shows the input, from the left
uniform int uProjection, uLayer;
uniform bool uSphere, uHasTruth, uHasPrediction, uHasDistances;
uniform bool uPick;           // points in the colors of their numbers

// Logarithm of the distance of a pixel; see results/html/distances.py.
float distanceOf(sampler2D map, ivec2 at) {
  vec2 bytes = round(texelFetch(map, at, 0).rg * 255.0);
  float value = 256.0 * bytes.r + bytes.g;
  return value == 0.0 ? UNKNOWN : mix(uScale.x, uScale.y, (value - 1.0) / 65534.0);
}

#ifdef VERTEX
uniform vec4 uCamera;         // of a photo: fx, fy, cx, cy in widths and heights
uniform vec3 uEye, uRight, uUp, uAhead;
uniform float uNear;          // nothing nearer to the eye is shown
uniform bool uByTruth;

flat out vec2 vUv;
flat out vec3 vNumber;

ivec2 size() {
  return uByTruth ? textureSize(uTruth, 0) : textureSize(uPrediction, 0);
}

// A point, and 1 where its distance is known.
vec4 pointOf(ivec2 at) {
  vec2 uv = (vec2(at) + 0.5) / vec2(size());
  float lon = (uv.x - 0.5) * 2.0 * PI, lat = (0.5 - uv.y) * PI;
  vec3 ray = uSphere ? vec3(cos(lat) * cos(lon), cos(lat) * sin(lon), sin(lat)) :
      vec3(1.0, (uv.x - uCamera.z) / uCamera.x, (uCamera.w - uv.y) / uCamera.y);
  float log = uByTruth ? distanceOf(uTruth, at) : distanceOf(uPrediction, at);
  return log == UNKNOWN ? vec4(0.0) : vec4(exp(log) * ray, 1.0);
}

// The way to a neighbor, and 1 where it is known.
vec4 neighbor(vec3 here, ivec2 at) {
  if (uSphere) at.x = (at.x + size().x) % size().x;
  bool outside = any(lessThan(at, ivec2(0))) || any(greaterThanEqual(at, size()));
  vec4 there = outside ? vec4(0.0) : pointOf(at);
  return there.w == 0.0 ? vec4(0.0) : vec4(there.xyz - here, 1.0);
}

// Along the surface, per step: half the way between both neighbors, or the way to the nearer one
// where the other is unknown or lies beyond an edge. Zero without neighbors.
vec3 along(vec3 here, ivec2 at, ivec2 step) {
  vec4 before = neighbor(here, at - step), after = neighbor(here, at + step);
  float back = length(before.xyz), forth = length(after.xyz);
  bool both = before.w * after.w > 0.0 && max(back, forth) < 3.0 * min(back, forth);
  if (both) return 0.5 * (after.xyz - before.xyz);
  return after.w == 0.0 || (before.w > 0.0 && back < forth) ? -before.xyz : after.xyz;
}

void main() {
  ivec2 size = size(), at = ivec2(gl_VertexID % size.x, gl_VertexID / size.x);
  vUv = (vec2(at) + 0.5) / vec2(size);
  int number = gl_VertexID + 1;
  vNumber = vec3(number & 255, (number >> 8) & 255, number >> 16) / 255.0;
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // not shown
  gl_PointSize = 1.0;
  // A row at latitude φ keeps the share cos φ of its points: as many per solid angle everywhere.
  float share = uSphere ? max(cos((0.5 - vUv.y) * PI), 1.0 / float(size.x)) : 1.0;
  vec4 here = pointOf(at);
  if (here.w == 0.0 || floor(float(at.x + 1) * share) == floor(float(at.x) * share)) return;
  vec3 seen = here.xyz - uEye;
  int columns = min(int(round(float(REACH) / share)), max(size.x / 4, 1));
  vec3 across = along(here.xyz, at, ivec2(columns, 0));
  vec3 down = along(here.xyz, at, ivec2(0, REACH));
  // Surfaces show their side towards the center; walls in front of the scene are left out.
  vec3 normal = cross(across, down);
  if (sign(dot(normal, here.xyz)) * dot(normal, seen) < -0.1 * length(normal) * length(seen)) return;
  // Points are squares that cover the gap to the next ones, but not beyond edges.
  float reach = ceil(1.0 / share) / float(columns);
  float gap = max(reach * length(across), length(down) / float(REACH));
  float pitch = (uSphere ? PI / float(size.y) : 1.0 / (uCamera.x * float(size.x))) * length(here.xyz);
  // Between an object and what is behind it, networks predict slopes that no surface has.
  if (gap > STEEP * pitch) return;
  gap = 1.45 * clamp(gap, pitch, 3.0 * pitch);
  vec3 view = vec3(dot(seen, uRight), dot(seen, uUp), dot(seen, uAhead));
  float side = 0.5 * max(uCanvas.x, uCanvas.y);
  gl_Position = vec4(view.xy / uReach * 2.0 * side / uCanvas, view.z - 2.0 * uNear, view.z);
  gl_PointSize = clamp(gap / (uReach * view.z) * side, 1.0, 32.0);
}
#else
out vec4 color;

vec2 onPlane(vec2 pixel) {
  return (pixel - 0.5 * uCanvas) / (0.5 * max(uCanvas.x, uCanvas.y)) * uReach;
}

vec3 ray(vec2 plane) {
  float lon = (uCenter.x - 0.5) * 2.0 * PI, lat = (0.5 - uCenter.y) * PI;
  vec3 front = vec3(cos(lat) * cos(lon), cos(lat) * sin(lon), sin(lat));
  vec3 right = vec3(-sin(lon), cos(lon), 0.0);
  vec3 up = vec3(-sin(lat) * cos(lon), -sin(lat) * sin(lon), cos(lat));
  float ahead = uProjection == PLANET ? 1.0 - 0.25 * dot(plane, plane) : 1.0;
  return normalize(ahead * front + plane.x * right + plane.y * up);
}

vec2 sphereToImage(vec3 d) {
  return vec2(atan(d.y, d.x) / (2.0 * PI) + 0.5, 0.5 - atan(d.z, length(d.xy)) / PI);
}

vec2 imageAt(vec2 pixel) {
  vec2 plane = onPlane(pixel);
  if (uProjection == FLAT) return uCenter + vec2(plane.x, -plane.y * uAspect);
  return sphereToImage(ray(plane));
}

bool inside(vec2 uv) {
  bool once = uSphere ? uProjection != FLAT || abs(uv.x - uCenter.x) <= 0.5 :
      uv.x >= 0.0 && uv.x <= 1.0;
  return once && uv.y >= 0.0 && uv.y <= 1.0;
}

// Columns of the image per pixel of the canvas, from directions and not from u: no seam at 180°.
float footprint(vec2 pixel) {
  float width = float(textureSize(uInput, 0).x);
  if (uProjection == FLAT) return 2.0 * uReach / max(uCanvas.x, uCanvas.y) * width;
  vec3 d = ray(onPlane(pixel));
  return max(length(dFdx(d)), length(dFdy(d))) * width / (2.0 * PI);
}

vec3 photo(vec2 uv, float level) {
  vec3 here = textureLod(uInput, uv, level).rgb;
  // Beyond the last row lies the other side of the pole: the rows meet there.
  float beyond = (abs(uv.y - 0.5) - 0.5) * float(textureSize(uInput, 0).y) + 0.5;
  if (!uSphere || beyond <= 0.0) return here;
  return mix(here, textureLod(uInput, uv + vec2(0.5, 0.0), level).rgb, min(beyond, 0.5));
}

ivec2 pixelAt(sampler2D map, vec2 uv) {
  ivec2 size = textureSize(map, 0);
  ivec2 at = ivec2(floor(vec2(fract(uv.x), uv.y) * vec2(size)));
  return clamp(at, ivec2(0), size - 1);
}

int classAt(sampler2D labels, vec2 uv) {
  return int(round(texelFetch(labels, pixelAt(labels, uv), 0).r * 255.0));
}

// Class and, in green and blue, object: different numbers on both sides of an outline.
int overlaid(vec2 uv) {
  vec3 color = uHasPrediction ? texelFetch(uPrediction, pixelAt(uPrediction, uv), 0).rgb :
      texelFetch(uTruth, pixelAt(uTruth, uv), 0).rgb;
  ivec3 bytes = ivec3(round(255.0 * color));
  return bytes.r + 256 * bytes.g + 65536 * bytes.b;
}

vec3 labels(vec3 photo, vec2 uv, float gray, float opacity) {
  int truth = uHasTruth ? classAt(uTruth, uv) : 0;
  int prediction = uHasPrediction ? classAt(uPrediction, uv) : 0;
  bool byTruth = uLayer == TRUTH || uLayer == ERROR || !uHasPrediction;
  int index = byTruth ? truth : prediction;
  vec4 entry = texelFetch(uColors, ivec2(index, 0), 0);
  bool visible = entry.a > 0.5;
  if (uLayer == OVERLAY) return visible && index > 0 ? mix(photo, entry.rgb, opacity) : photo;
  vec3 pale = vec3(0.75 + 0.25 * gray);
  if (uLayer == CONFIDENCE) {
    float sure = texelFetch(uConfidence, pixelAt(uConfidence, uv), 0).r;
    return prediction == 0 ? UNLABELED : mix(UNSURE, pale, sure);
  }
  if (!visible) return vec3(0.4 * gray);
  if (uLayer != ERROR) return entry.rgb;
  if (truth == 0) return UNLABELED;
  return truth == prediction ? pale : WRONG;
}

vec3 distances(vec3 photo, vec2 uv, float gray) {
  float truth = uHasTruth ? distanceOf(uTruth, pixelAt(uTruth, uv)) : UNKNOWN;
  float prediction = uHasPrediction ? distanceOf(uPrediction, pixelAt(uPrediction, uv)) : UNKNOWN;
  if (uLayer == ERROR) {
    if (truth == UNKNOWN || prediction == UNKNOWN) return UNLABELED;
    return mix(vec3(0.75 + 0.25 * gray), WRONG, min(abs(prediction - truth) / WORST, 1.0));
  }
  float log = uLayer == TRUTH || !uHasPrediction ? truth : prediction;
  if (log == UNKNOWN) return uLayer == OVERLAY ? photo : vec3(0.4 * gray);
  float place = clamp((log - uScale.z) / (uScale.w - uScale.z), 0.0, 1.0);
  vec3 entry = texelFetch(uColors, ivec2(round(255.0 * place), 0), 0).rgb;
  return uLayer == OVERLAY ? mix(photo, entry, uOpacity) : entry;
}

vec3 shown(vec3 photo, vec2 uv, float opacity) {
  if (uLayer == INPUT) return photo;
  float gray = dot(photo, vec3(0.299, 0.587, 0.114));
  return uHasDistances ? distances(photo, uv, gray) : labels(photo, uv, gray, opacity);
}

#ifdef POINTS
flat in vec2 vUv;
flat in vec3 vNumber;

void main() {
  color = vec4(uPick ? vNumber : shown(photo(vUv, 0.0), vUv, uOpacity), 1.0);
}
#else
void main() {
  vec2 pixel = gl_FragCoord.xy;
  vec2 uv = imageAt(pixel);
  float level = log2(max(footprint(pixel), 1.0));
  if (!inside(uv)) {
    color = vec4(OUTSIDE, 1.0);
    return;
  }
  vec3 under = photo(uv, level), sum = vec3(0.0);
  float divider = uSwipe * uCanvas.x - pixel.x;
  if (divider > 0.0) {
    color = vec4(divider < 2.0 ? vec3(1.0) : under, 1.0);
    return;
  }
  // Overlaid classes have outlines of their full color, 2 to 3 pixels of the canvas wide.
  float opacity = uOpacity;
  if (uLayer == OVERLAY && !uHasDistances) {
    int here = overlaid(uv);
    for (int k = 0; k < 4; k++) {
      vec2 near = imageAt(pixel + 4.0 * OFFSETS[k]);
      if (inside(near) && overlaid(near) != here) opacity = min(2.5 * uOpacity, 1.0);
    }
  }
  for (int k = 0; k < 4; k++) sum += shown(under, imageAt(pixel + OFFSETS[k]), opacity);
  color = vec4(sum / 4.0, 1.0);
}
#endif
#endif
