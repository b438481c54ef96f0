// A plan on canvases: places below, what moves and what is chosen above, a floor plan and a grid on the ground.  From afar
// a traverse is one thin line; near, its places are discs with their headings.  More than a few thousand places are
// squares written straight into the picture, which takes milliseconds.
import { plain } from "./view.js";

const DENSE = 5000;
const NEAR = 14;
const FEW = 150;
const APART = 7;
const GRID = 90;
const MARGIN = 0.06;

/** Options: onChoose(number or null), onHover(number or null), onView(view), onPoint({x, y} in metres or null), onLasso(numbers);
 * ground: a canvas below the others. */
export class PlanCanvas {
  constructor(places, above, options) {
    Object.assign(this, { places, above, options });
    this.view = { scale: 1, x: 0, y: 0 };
    this.content = null;
    this.shown = new Int32Array(0);
    this.shownCount = 0;
    this.queued = false;
    this.observer = new ResizeObserver(() => this.resized());
    this.observer.observe(above);
    this.listen();
  }

  close() {
    this.observer.disconnect();
    this.controller.abort();
  }

  /** content: {x, y, angle, group, colours, visible, gaps, lines}; arrays by place, colours and visible by group. */
  show(content, fit) {
    this.content = content;
    if (this.shown.length < content.x.length) this.shown = new Int32Array(content.x.length);
    if (fit) this.fit();
    this.draw();
  }

  /** marks: {chosen, hovered, misleading (numbers), robots: [{x, y, angle, ellipse, trail, colour, label}], dots,
   * ways: lists of [{x, y, spread}] in metres, which all are to be seen, too}. */
  mark(marks) {
    this.marks = { ...this.marks, ...marks };
    this.drawAbove();
  }

  resized() {
    const ratio = devicePixelRatio || 1;
    const [width, height] = [this.above.clientWidth, this.above.clientHeight];
    if (!width || !height) return;
    const first = !this.width;
    Object.assign(this, { ratio, width, height });
    for (const canvas of [this.places, this.above, this.options.ground].filter(Boolean)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    if (first && this.content) this.fit();
    this.draw();
  }

  // Where one looks

  fit() {
    const { x, y } = this.content;
    let [left, right, bottom, top] = [Infinity, -Infinity, Infinity, -Infinity];
    for (let one = 0; one < x.length; one += 1) {
      if (Number.isNaN(x[one])) continue;
      if (x[one] < left) left = x[one];
      if (x[one] > right) right = x[one];
      if (y[one] < bottom) bottom = y[one];
      if (y[one] > top) top = y[one];
    }
    for (const point of (this.marks?.ways || []).flat()) {
      [left, right] = [Math.min(left, point.x), Math.max(right, point.x)];
      [bottom, top] = [Math.min(bottom, point.y), Math.max(top, point.y)];
    }
    if (left > right || !this.width) return;
    const [wide, high] = [Math.max(right - left, 1e-3), Math.max(top - bottom, 1e-3)];
    const scale = (1 - 2 * MARGIN) * Math.min(this.width / wide, this.height / high);
    this.look({ scale: Math.min(scale, 400), x: (left + right) / 2, y: (bottom + top) / 2 });
  }

  look(view) {
    this.view = { ...this.view, ...view };
    this.options.onView?.(this.view);
    this.draw();
  }

  centre(number) {
    const { x, y } = this.content;
    if (!Number.isNaN(x[number])) this.look({ x: x[number], y: y[number] });
  }

  zoom(factor, [atX, atY] = [this.width / 2, this.height / 2]) {
    const { scale, x, y } = this.view;
    const larger = Math.min(Math.max(scale * factor, 1e-6), 1e5);
    const [dx, dy] = [(atX - this.width / 2) / scale, (this.height / 2 - atY) / scale];
    const kept = scale / larger;
    this.look({ scale: larger, x: x + dx * (1 - kept), y: y + dy * (1 - kept) });
  }

  pan(dx, dy) {
    const { scale, x, y } = this.view;
    this.look({ x: x - dx / scale, y: y + dy / scale });
  }

  // Drawing

  draw() {
    if (this.queued) return;
    this.queued = true;
    requestAnimationFrame(() => {
      this.queued = false;
      if (!this.content || !this.width) return;
      this.drawGround();
      this.select();
      if (this.shownCount > DENSE) this.drawDense();
      else this.drawSparse();
      this.drawAbove();
      this.frames = (this.frames || 0) + 1;
    });
  }

  /** ground: {grid, image, placed: the matrix from the image's pixels to metres}. */
  lay(ground) {
    this.ground = ground;
    this.draw();
  }

  drawGround() {
    if (!this.options.ground) return;
    const context = this.options.ground.getContext("2d");
    const { grid = false, image = null, placed = null } = this.ground || {};
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    context.clearRect(0, 0, this.width, this.height);
    if (image && placed) this.drawImage(context, image, placed);
    if (grid && this.marks?.tints) this.drawGrid(context);
  }

  drawImage(context, image, { a, b, x, y }) {
    // A pixel (u, v), v downwards, lies at (a u + b v + x, b u - a v + y) metres.
    const { scale } = this.view;
    const [left, top] = this.at(x, y);
    context.save();
    context.globalAlpha = 0.6;
    context.transform(a * scale, -b * scale, b * scale, a * scale, left, top);
    context.drawImage(image, 0, 0);
    context.restore();
  }

  drawGrid(context) {
    const { scale, x: cx, y: cy } = this.view;
    const wanted = GRID / scale;
    const power = 10 ** Math.floor(Math.log10(wanted));
    const step = [1, 2, 5, 10].map((one) => one * power).find((one) => one >= wanted);
    const { line, faint } = this.marks.tints;
    context.strokeStyle = line;
    context.fillStyle = faint;
    context.font = "11px system-ui, sans-serif";
    context.lineWidth = 1;
    const digits = Math.max(0, -Math.floor(Math.log10(step)));
    const [halfX, halfY] = [this.width / 2 / scale, this.height / 2 / scale];
    context.beginPath();
    for (let x = Math.ceil((cx - halfX) / step) * step; x <= cx + halfX; x += step) {
      const [px] = this.at(x, 0);
      context.moveTo(px, 0);
      context.lineTo(px, this.height);
      context.fillText(x.toFixed(digits), px + 3, this.height - 6);
    }
    for (let y = Math.ceil((cy - halfY) / step) * step; y <= cy + halfY; y += step) {
      const [, py] = this.at(0, y);
      context.moveTo(0, py);
      context.lineTo(this.width, py);
      context.fillText(y.toFixed(digits), this.width - 44, py - 4);
    }
    context.stroke();
  }

  /** Which places lie in the picture. */
  select() {
    const { x, y, group, visible } = this.content;
    const { scale, x: cx, y: cy } = this.view;
    const [halfX, halfY] = [this.width / 2 / scale + 8 / scale, this.height / 2 / scale + 8 / scale];
    let count = 0;
    for (let one = 0; one < x.length; one += 1) {
      const [dx, dy] = [x[one] - cx, y[one] - cy];
      if (dx > -halfX && dx < halfX && dy > -halfY && dy < halfY && visible[group[one]]) this.shown[count++] = one;
    }
    this.shownCount = count;
  }

  drawDense() {
    const { x, y, group, numbers } = this.content;
    const [wide, high] = [this.places.width, this.places.height];
    const context = this.places.getContext("2d");
    if (this.image?.width !== wide || this.image?.height !== high) this.image = context.createImageData(wide, high);
    const pixels = new Uint32Array(this.image.data.buffer);
    pixels.fill(0);
    const scale = this.view.scale * this.ratio;
    const [offsetX, offsetY] = [wide / 2 - this.view.x * scale, high / 2 + this.view.y * scale];
    const size = Math.max(2, Math.round((this.shownCount > 40_000 ? 2 : 3) * this.ratio));
    for (let one = 0; one < this.shownCount; one += 1) {
      const number = this.shown[one];
      const left = Math.round(x[number] * scale + offsetX - size / 2);
      const top = Math.round(offsetY - y[number] * scale - size / 2);
      if (left < 0 || top < 0 || left + size > wide || top + size > high) continue;
      const pixel = numbers[group[number]];
      for (let row = top * wide + left, end = row + size * wide; row < end; row += wide) {
        for (let column = 0; column < size; column += 1) pixels[row + column] = pixel;
      }
    }
    context.putImageData(this.image, 0, 0);
  }

  drawSparse() {
    const context = this.places.getContext("2d");
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    context.clearRect(0, 0, this.width, this.height);
    const radius = Math.min(7, Math.max(2.5, this.view.scale * 0.25, 9 - Math.log2(1 + this.shownCount / 12)));
    const near = this.isNear();
    this.drawLines(context, near);
    const byGroup = new Map();
    for (let one = 0; one < this.shownCount; one += 1) {
      const number = this.shown[one];
      const group = this.content.group[number];
      if (!near && this.content.lines[group].length > 1) continue; // its line shows it
      if (!byGroup.has(group)) byGroup.set(group, []);
      byGroup.get(group).push(number);
    }
    for (const [group, numbers] of byGroup) this.drawDiscs(context, numbers, this.content.colours[group], radius);
  }

  /** Whether there is room for a disc for each place in the picture. */
  isNear() {
    if (this.shownCount <= FEW) return true;
    let [sum, count] = [0, 0];
    const pace = Math.max(1, Math.floor(this.shownCount / 400));
    for (let one = pace; one < this.shownCount; one += pace) {
      const [before, here] = [this.shown[one] - 1, this.shown[one]];
      if (this.content.group[before] !== this.content.group[here]) continue;
      const [ax, ay] = this.pixel(before);
      const [bx, by] = this.pixel(here);
      if (Number.isNaN(ax + bx)) continue;
      sum += Math.hypot(ax - bx, ay - by);
      count += 1;
    }
    return count > 0 && sum / count >= APART;
  }

  drawDiscs(context, numbers, colour, radius) {
    const { angle } = this.content;
    context.fillStyle = context.strokeStyle = colour;
    context.lineWidth = Math.max(1, radius / 3);
    context.beginPath();
    for (const number of numbers) {
      const [px, py] = this.pixel(number);
      context.moveTo(px + radius, py);
      context.arc(px, py, radius, 0, 2 * Math.PI);
    }
    context.fill();
    if (!angle) return;
    context.beginPath();
    for (const number of numbers) {
      if (Number.isNaN(angle[number])) continue;
      const [px, py] = this.pixel(number);
      context.moveTo(px, py);
      context.lineTo(px + 2.4 * radius * Math.cos(angle[number]), py - 2.4 * radius * Math.sin(angle[number]));
    }
    context.stroke();
  }

  drawLines(context, near) {
    const { lines, colours, visible } = this.content;
    context.lineWidth = near ? 1 : 1.5;
    context.globalAlpha = near ? 0.35 : 1;
    lines.forEach((places, group) => {
      if (!visible[group] || places.length > 4 * DENSE) return;
      context.strokeStyle = colours[group];
      context.beginPath();
      let before = null;
      for (const number of places) {
        if (Number.isNaN(this.content.x[number])) continue;
        const point = this.pixel(number);
        if (before === null) context.moveTo(...point);
        else context.lineTo(...point);
        before = number;
      }
      context.stroke();
    });
    context.globalAlpha = 1;
  }

  pixel(number) {
    return this.at(this.content.x[number], this.content.y[number]);
  }

  at(x, y) {
    const { scale, x: cx, y: cy } = this.view;
    return [(x - cx) * scale + this.width / 2, this.height / 2 - (y - cy) * scale];
  }

  /** The point in metres at a pixel. */
  spot(atX, atY) {
    const { scale, x, y } = this.view;
    return { x: x + (atX - this.width / 2) / scale, y: y + (this.height / 2 - atY) / scale };
  }

  drawAbove() {
    if (!this.content || !this.width) return;
    const context = this.above.getContext("2d");
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    context.clearRect(0, 0, this.width, this.height);
    this.drawGaps(context);
    const { chosen = null, hovered = null, misleading = [], selected = [], dots = [], robots = [], ways = [], tints } = this.marks || {};
    if (!tints) return;
    for (const number of misleading) this.ring(context, number, 8, tints.ambiguous, 2);
    for (const way of ways) this.drawWay(context, way, tints);
    for (const dot of dots) this.drawDot(context, dot, tints);
    for (const robot of robots) this.drawRobot(context, robot, tints);
    for (const number of selected) this.ring(context, number, 7, tints.text, 1.5);
    if (this.lasso) this.drawLasso(context, tints);
    if (hovered !== null) this.ring(context, hovered, 9, tints.text, 1.5);
    if (chosen !== null) this.ring(context, chosen, 10, tints.accent, 3);
  }

  /** A way as a line, within a band as wide as its standard deviation. */
  drawWay(context, way, tints) {
    context.fillStyle = context.strokeStyle = tints.ambiguous;
    context.globalAlpha = 0.2;
    context.beginPath();
    for (const { x, y, spread } of way) {
      const [px, py] = this.at(x, y);
      const radius = Math.max(3, spread * this.view.scale);
      context.moveTo(px + radius, py);
      context.arc(px, py, radius, 0, 2 * Math.PI);
    }
    context.fill();
    context.globalAlpha = 1;
    context.lineWidth = 2.5;
    context.beginPath();
    for (const { x, y } of way) context.lineTo(...this.at(x, y));
    context.stroke();
  }

  drawLasso(context, tints) {
    context.strokeStyle = tints.accent;
    context.lineWidth = 1.5;
    context.setLineDash([4, 3]);
    context.beginPath();
    for (const point of this.lasso) context.lineTo(...point);
    context.closePath();
    context.stroke();
    context.setLineDash([]);
  }

  /** The places within the lasso, of those in the picture. */
  caught() {
    const found = [];
    for (let one = 0; one < this.shownCount; one += 1) {
      if (isWithin(this.pixel(this.shown[one]), this.lasso)) found.push(this.shown[one]);
    }
    return found;
  }

  drawGaps(context) {
    const { gaps, x, y, group, visible } = this.content;
    if (!gaps.length || !this.marks?.tints) return;
    context.strokeStyle = this.marks.tints.danger;
    context.setLineDash([5, 4]);
    context.lineWidth = 1.5;
    context.beginPath();
    for (const { from, to } of gaps) {
      if (!visible[group[from]]) continue;
      context.moveTo(...this.at(x[from], y[from]));
      context.lineTo(...this.at(x[to], y[to]));
    }
    context.stroke();
    context.setLineDash([]);
  }

  ring(context, number, radius, colour, width) {
    if (Number.isNaN(this.content.x[number])) return;
    const [px, py] = this.pixel(number);
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.beginPath();
    context.arc(px, py, radius, 0, 2 * Math.PI);
    context.stroke();
  }

  drawDot(context, { x, y, verdict, age }, tints) {
    const [px, py] = this.at(x, y);
    context.globalAlpha = Math.max(0.15, 1 - age);
    context.fillStyle = tints[verdict];
    context.beginPath();
    context.arc(px, py, 5, 0, 2 * Math.PI);
    context.fill();
    context.globalAlpha = 1;
  }

  drawRobot(context, robot, tints) {
    const tint = robot.silent ? tints.faint : tints[robot.verdict] || tints.accent;
    context.strokeStyle = context.fillStyle = tint;
    context.lineWidth = 2;
    context.beginPath();
    robot.trail.forEach(({ x, y }, one) => (one ? context.lineTo(...this.at(x, y)) : context.moveTo(...this.at(x, y))));
    context.stroke();
    const [px, py] = this.at(robot.x, robot.y);
    if (robot.ellipse && !robot.silent) {
      const { major, minor, turn } = robot.ellipse;
      const { scale } = this.view;
      context.beginPath();
      context.ellipse(px, py, Math.max(4, major * scale), Math.max(4, minor * scale), -turn, 0, 2 * Math.PI);
      context.globalAlpha = 0.18;
      context.fill();
      context.globalAlpha = 1;
      context.stroke();
    }
    const angle = robot.angle ?? 0;
    context.beginPath();
    for (const [turn, reach] of [[0, 12], [2.5, 9], [-2.5, 9]]) {
      context.lineTo(px + reach * Math.cos(angle + turn), py - reach * Math.sin(angle + turn));
    }
    context.closePath();
    context.fill();
    context.font = "600 12px system-ui, sans-serif";
    context.strokeStyle = tints.surface;
    context.lineWidth = 4;
    context.lineJoin = "round";
    const label = plain(robot.label);
    const room = this.width - px - 16 - context.measureText(label).width;
    const beside = px > this.width || room > 0 ? [px + 12, py - 8] : [px + 12 + room, py - 18];
    context.strokeText(label, ...beside);
    context.fillStyle = robot.silent ? tints.faint : tints.text;
    context.fillText(label, ...beside);
  }

  // Hands

  nearest(atX, atY) {
    let [best, least] = [null, NEAR * NEAR];
    for (let one = 0; one < this.shownCount; one += 1) {
      const [px, py] = this.pixel(this.shown[one]);
      const distance = (px - atX) ** 2 + (py - atY) ** 2;
      if (distance < least) [best, least] = [this.shown[one], distance];
    }
    return best;
  }

  listen() {
    this.controller = new AbortController();
    const on = (name, call, options) =>
      this.above.addEventListener(name, call, { signal: this.controller.signal, ...options });
    const touches = new Map();
    let moved = 0;
    on("pointerdown", (event) => {
      this.above.setPointerCapture(event.pointerId);
      touches.set(event.pointerId, [event.offsetX, event.offsetY]);
      moved = 0;
      this.lasso = this.options.onLasso && (event.shiftKey || this.catching) && touches.size === 1 ? [[event.offsetX, event.offsetY]] : null;
    });
    on("pointermove", (event) => {
      const before = touches.get(event.pointerId);
      const here = [event.offsetX, event.offsetY];
      if (this.lasso) {
        this.lasso.push(here);
        this.drawAbove();
        return;
      }
      if (!before) {
        this.options.onPoint?.(this.spot(...here));
        this.options.onHover?.(this.content ? this.nearest(...here) : null);
        return;
      }
      const others = [...touches].filter(([id]) => id !== event.pointerId).map(([, point]) => point);
      moved += Math.hypot(here[0] - before[0], here[1] - before[1]);
      if (others.length) {
        const apart = (point) => Math.hypot(point[0] - others[0][0], point[1] - others[0][1]);
        this.zoom(apart(here) / Math.max(1, apart(before)), [(here[0] + others[0][0]) / 2, (here[1] + others[0][1]) / 2]);
      } else {
        this.pan(here[0] - before[0], here[1] - before[1]);
      }
      touches.set(event.pointerId, here);
    });
    on("pointerup", (event) => {
      touches.delete(event.pointerId);
      if (this.lasso) {
        const found = this.lasso.length > 2 ? this.caught() : [];
        this.lasso = null;
        this.options.onLasso(found);
        this.drawAbove();
        return;
      }
      if (moved < 4 && this.content) this.options.onChoose?.(this.nearest(event.offsetX, event.offsetY));
    });
    on("pointercancel", (event) => {
      touches.delete(event.pointerId);
      this.lasso = null;
    });
    on("pointerleave", () => {
      this.options.onHover?.(null);
      this.options.onPoint?.(null);
    });
    on("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), [event.offsetX, event.offsetY]);
    }, { passive: false });
    on("keydown", (event) => this.typed(event));
  }

  typed(event) {
    const step = 60;
    const keys = {
      ArrowLeft: () => this.pan(step, 0),
      ArrowRight: () => this.pan(-step, 0),
      ArrowUp: () => this.pan(0, step),
      ArrowDown: () => this.pan(0, -step),
      "+": () => this.zoom(1.3),
      "=": () => this.zoom(1.3),
      "-": () => this.zoom(1 / 1.3),
      0: () => this.fit(),
      n: () => this.options.onStep?.(1),
      p: () => this.options.onStep?.(-1),
    };
    if (!keys[event.key] || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    keys[event.key]();
  }
}

/** Whether a point lies within a polygon. */
function isWithin([x, y], corners) {
  let inside = false;
  corners.forEach(([ax, ay], one) => {
    const [bx, by] = corners[(one + 1) % corners.length];
    if (ay > y !== by > y && x < ax + ((y - ay) * (bx - ax)) / (by - ay)) inside = !inside;
  });
  return inside;
}
