#version 300 es
// One pixel of the viewer: where it looks, what is there, and in which colors that is shown.
// Positions in an image are u to the right and v down, 0 to 1; longitude 0 is u = 1/2, the north
// pole v = 0.
precision highp float;
precision highp int;
precision highp sampler2D;

const float PI = 3.14159265358979;
const int INSIDE = 0, PLANET = 1, FLAT = 2;
const int INPUT = 0, TRUTH = 1, PREDICTION = 2, ERROR = 3, OVERLAY = 4;
const vec3 OUTSIDE = vec3(0.086, 0.094, 0.11);
const vec3 WRONG = vec3(214.0, 39.0, 40.0) / 255.0, UNLABELED = vec3(110.0 / 255.0);
// Four samples in a turned square: class borders without steps.
const vec2 OFFSETS[4] =
    vec2[](vec2(-0.125, -0.375), vec2(0.375, -0.125), vec2(0.125, 0.375), vec2(-0.375, 0.125));

uniform sampler2D uInput, uTruth, uPrediction;
uniform sampler2D uClasses;   // a color per class; alpha 0: hidden
uniform vec2 uCanvas;         // pixels
uniform vec2 uCenter;         // u, v in the middle of the canvas
uniform float uReach;         // tangent plane, stereographic plane or u at half the longer side
uniform float uAspect;        // width of the image over its height
uniform float uOpacity;
uniform int uProjection, uLayer;
uniform bool uSphere, uHasTruth, uHasPrediction;

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

int classAt(sampler2D labels, vec2 uv) {
  ivec2 size = textureSize(labels, 0);
  ivec2 at = ivec2(floor(vec2(fract(uv.x), uv.y) * vec2(size)));
  return int(round(texelFetch(labels, clamp(at, ivec2(0), size - 1), 0).r * 255.0));
}

vec3 shown(vec3 photo, vec2 uv) {
  int truth = uHasTruth ? classAt(uTruth, uv) : 0;
  int prediction = uHasPrediction ? classAt(uPrediction, uv) : 0;
  bool byTruth = uLayer == TRUTH || uLayer == ERROR || !uHasPrediction;
  int index = byTruth ? truth : prediction;
  vec4 entry = texelFetch(uClasses, ivec2(index, 0), 0);
  bool visible = entry.a > 0.5;
  float gray = dot(photo, vec3(0.299, 0.587, 0.114));
  if (uLayer == OVERLAY) return visible && index > 0 ? mix(photo, entry.rgb, uOpacity) : photo;
  if (!visible) return vec3(0.4 * gray);
  if (uLayer != ERROR) return entry.rgb;
  if (truth == 0) return UNLABELED;
  return truth == prediction ? vec3(0.75 + 0.25 * gray) : WRONG;
}

void main() {
  vec2 pixel = gl_FragCoord.xy;
  vec2 uv = imageAt(pixel);
  float level = log2(max(footprint(pixel), 1.0));
  if (!inside(uv)) {
    color = vec4(OUTSIDE, 1.0);
    return;
  }
  vec3 under = photo(uv, level), sum = vec3(0.0);
  if (uLayer == INPUT) {
    color = vec4(under, 1.0);
    return;
  }
  for (int k = 0; k < 4; k++) sum += shown(under, imageAt(pixel + OFFSETS[k]));
  color = vec4(sum / 4.0, 1.0);
}
