// Point clouds to pixels, without a document: what the page draws, and what the tests run in node.
//
// A cloud is {count, xyz, range, intensity?, semantic?, instance?, origin?}, arrays of P points;
// x forward, y left, z up, metres. A colour is one uint32 0xAABBGGRR, 0 where nothing is drawn.
// A frame is {width, height, colour, depth, index}, arrays over its pixels; index -1 is empty.
const Cloud = (() => {
  "use strict";

  const NEAR_M = 0.3;
  const POINT_WIDTH_M = 0.05; // drawn width of a near point at point size 1
  const GREY = 0xffa09a92;
  const BASE_RATIO = 2 * Math.tan((25 * Math.PI) / 180);

  const pack = (red, green, blue) => (0xff000000 | (blue << 16) | (green << 8) | red) >>> 0;
  const packHex = (hex) => {
    const rgb = parseInt(hex.slice(1), 16);
    return pack(rgb >> 16, (rgb >> 8) & 255, rgb & 255);
  };
  const cssColour = (colour) =>
    `rgb(${colour & 255}, ${(colour >> 8) & 255}, ${(colour >> 16) & 255})`;

  function bytesOf(base64) {
    return Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  }

  /** Cloud of one packed scan; the columns and their order are as in `pack_scan` of page.py. */
  async function unpack(header, base64) {
    const zipped = new Blob([bytesOf(base64)]).stream();
    const stream = zipped.pipeThrough(new DecompressionStream("deflate"));
    const bytes = await new Response(stream).arrayBuffer();
    const count = header.count;
    let offset = 0;
    const take = (type) => {
      const column = new type(bytes.slice(offset, offset + count * type.BYTES_PER_ELEMENT));
      offset += column.byteLength;
      return column;
    };
    const xyz = new Float32Array(3 * count);
    for (let axis = 0; axis < 3; axis++) {
      const steps = take(Int16Array);
      for (let i = 0, step = 0; i < count; i++) {
        step = ((step + steps[i]) << 16) >> 16; // the differences wrap as int16 does
        xyz[3 * i + axis] = step * header.step_m;
      }
    }
    const cloud = { count, xyz, range: new Float32Array(count) };
    for (let i = 0; i < count; i++) {
      cloud.range[i] = Math.hypot(xyz[3 * i], xyz[3 * i + 1], xyz[3 * i + 2]);
    }
    if (header.columns.includes("semantic")) {
      cloud.semantic = take(Uint16Array);
      cloud.instance = take(Uint16Array);
    }
    if (header.columns.includes("intensity")) {
      cloud.intensity = Float32Array.from(take(Uint8Array), (v) => (v / 255) * header.intensity_max);
    }
    if (header.columns.includes("origin")) cloud.origin = take(Uint8Array);
    return cloud;
  }

  /** Place 0..255 of a value on a scale {low, high, power}; beyond the limits the end colours. */
  function scaleIndex(scale, value) {
    const share = (value - scale.low) / (scale.high - scale.low);
    return share <= 0 ? 0 : Math.min(255, Math.floor(Math.pow(share, scale.power) * 256));
  }

  /** Distinct bright colour of an instance: hues a golden angle apart; 0 is no instance. */
  function instanceColour(instance) {
    if (instance === 0) return pack(86, 96, 110);
    const hue = (instance * 0.61803398875) % 1;
    const channel = (shift) => {
      const wave = Math.abs((((hue + shift) * 6) % 6) - 3) - 1;
      return Math.round(255 * (0.3 + 0.7 * Math.min(1, Math.max(0, wave))));
    };
    return pack(channel(0), channel(2 / 3), channel(1 / 3));
  }

  /**
   * Colours of all points in a mode. `table` is a scale {low, high, power, colours: Uint32Array},
   * or a Map of category to colour, or null for instances; `hidden` holds categories not drawn.
   * Points of a cloud that lacks what the mode shows are grey.
   */
  function colourise(cloud, mode, table, hidden) {
    const colours = new Uint32Array(cloud.count);
    if (mode !== "height" && !cloud[mode]) return colours.fill(GREY);
    for (let i = 0; i < cloud.count; i++) {
      const v = mode === "height" ? cloud.xyz[3 * i + 2] : cloud[mode][i];
      if (mode === "instance") colours[i] = instanceColour(v);
      else if (table instanceof Map) colours[i] = hidden.has(v) ? 0 : table.get(v);
      else colours[i] = table.colours[scaleIndex(table, v)];
    }
    return colours;
  }

  /** How many points there are of each category. */
  function countValues(values) {
    const counts = new Map();
    for (const value of values) counts.set(value, (counts.get(value) || 0) + 1);
    return counts;
  }

  /**
   * What maps points to pixels. A camera is {target, distance, yaw, pitch, flat}: it looks along
   * yaw (0 is +x, left is positive), downwards by pitch, at the target. Flat means parallel rays,
   * of the same size at the target. The focal length is such that a square picture shows 50
   * degrees.
   */
  function projectionOf(camera, width, height) {
    const { target, distance, yaw, pitch, flat } = camera;
    const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    const forward = [cp * cy, cp * sy, -sp];
    const eye = target.map((value, axis) => value - distance * forward[axis]);
    const focal = Math.sqrt(width * height) / BASE_RATIO;
    return {
      ...{ eye, forward, focal, width, height, distance, flat },
      right: [sy, -cy, 0],
      up: [sp * cy, sp * sy, cp],
    };
  }

  /** [column, row, depth] of one point in pixels and metres; null where it is behind the camera. */
  function project(projection, x, y, z) {
    const { eye, right, up, forward, focal, width, height, distance, flat } = projection;
    const [dx, dy, dz] = [x - eye[0], y - eye[1], z - eye[2]];
    const depth = dx * forward[0] + dy * forward[1] + dz * forward[2];
    if (!flat && depth < NEAR_M) return null;
    const scale = focal / (flat ? distance : depth);
    return [
      width / 2 + scale * (dx * right[0] + dy * right[1] + dz * right[2]),
      height / 2 - scale * (dx * up[0] + dy * up[1] + dz * up[2]),
      depth,
    ];
  }

  function newFrame(width, height) {
    const pixels = width * height;
    const [colour, depth] = [new Uint32Array(pixels), new Float32Array(pixels)];
    return { width, height, colour, depth, index: new Int32Array(pixels).fill(-1) };
  }

  /**
   * Draws the points whose colour is not 0: near ones hide far ones and are larger, far ones fade
   * to the colour `fadeTo` [red, green, blue], if given. `size` is the side of the smallest square
   * in pixels.
   */
  function drawPoints(frame, projection, cloud, colours, size, fadeTo) {
    const { width, height, colour, depth, index } = frame;
    const { eye, right, up, forward, focal, distance, flat } = projection;
    const [ex, ey, ez] = eye;
    const [rx, ry] = right;
    const [ux, uy, uz] = up;
    const [fx, fy, fz] = forward;
    const { xyz, count } = cloud;
    const [red0, green0, blue0] = fadeTo || [0, 0, 0];
    const fades = fadeTo !== null && !flat;
    const smallest = Math.max(1, Math.round(size));
    const largest = Math.max(smallest, Math.round(3 * size));
    const hazeStart = 20 + distance;
    const hazeLength = 90 + distance;
    colour.fill(0);
    depth.fill(Infinity);
    index.fill(-1);
    for (let i = 0, k = 0; i < count; i++, k += 3) {
      if (colours[i] === 0) continue;
      const dx = xyz[k] - ex, dy = xyz[k + 1] - ey, dz = xyz[k + 2] - ez;
      const far = dx * fx + dy * fy + dz * fz;
      if (!flat && far < NEAR_M) continue;
      const scale = focal / (flat ? distance : far);
      const column = width / 2 + scale * (dx * rx + dy * ry);
      const row = height / 2 - scale * (dx * ux + dy * uy + dz * uz);
      if (!(column >= 0 && column < width && row >= 0 && row < height)) continue;
      const wanted = Math.round(POINT_WIDTH_M * size * scale);
      const side = wanted < smallest ? smallest : wanted > largest ? largest : wanted;
      let rgba = colours[i];
      const haze = fades ? Math.min(0.6, (far - hazeStart) / hazeLength) : 0;
      if (haze > 0) {
        rgba = pack(
          (rgba & 255) + haze * (red0 - (rgba & 255)),
          ((rgba >> 8) & 255) + haze * (green0 - ((rgba >> 8) & 255)),
          ((rgba >> 16) & 255) + haze * (blue0 - ((rgba >> 16) & 255)),
        );
      }
      const left = Math.floor(column) - (side >> 1), top = Math.floor(row) - (side >> 1);
      for (let down = 0; down < side; down++) {
        const y = top + down;
        if (y < 0 || y >= height) continue;
        const corner = side > 3 && (down === 0 || down === side - 1) ? 1 : 0; // large ones are round
        const last = Math.min(width, left + side - corner);
        for (let x = Math.max(0, left + corner); x < last; x++) {
          const pixel = y * width + x;
          if (far < depth[pixel]) {
            depth[pixel] = far;
            colour[pixel] = rgba;
            index[pixel] = i;
          }
        }
      }
    }
  }

  /** Drawn point nearest to a pixel, at most `radius` pixels away; -1 where there is none. */
  function pick(frame, column, row, radius) {
    let best = -1, bestDistance = radius * radius + 1e-6;
    const [x0, y0] = [Math.floor(column), Math.floor(row)];
    const reach = Math.ceil(radius);
    for (let y = Math.max(0, y0 - reach); y <= Math.min(frame.height - 1, y0 + reach); y++) {
      for (let x = Math.max(0, x0 - reach); x <= Math.min(frame.width - 1, x0 + reach); x++) {
        const found = frame.index[y * frame.width + x];
        const distance = (x - x0) ** 2 + (y - y0) ** 2;
        if (found >= 0 && distance < bestDistance) [best, bestDistance] = [found, distance];
      }
    }
    return best;
  }

  return {
    ...{ bytesOf, unpack, scaleIndex, instanceColour, colourise, countValues },
    ...{ projectionOf, project, newFrame, drawPoints, pick, pack, packHex, cssColour },
  };
})();
