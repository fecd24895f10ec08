// What the headset shows: the joints of both hands, a panel with the state of each and of the
// emergency stop, and the disc that is the emergency stop.

const PANEL = { width: 0.75, height: 0.375, distance: 1.0, drop: -0.1 }; // [m]
const PIXELS = { width: 1152, height: 576 };
const DISC_PIXELS = { width: 256, height: 256 };
const POINT_SIZE = 0.009; // [m]
const PANEL_PERIOD = 250; // [ms]

const VERTEX = `
attribute vec3 position;
attribute vec2 uv;
uniform mat4 projection, view;
uniform float size;
varying vec2 place;
void main() {
  gl_Position = projection * view * vec4(position, 1.0);
  gl_PointSize = size * projection[1][1] / gl_Position.w;
  place = uv;
}`;
const FRAGMENT = `
precision mediump float;
uniform sampler2D board;
uniform vec4 colour;
uniform bool isBoard;
varying vec2 place;
void main() {
  gl_FragColor = isBoard ? texture2D(board, place) : colour;
  if (isBoard ? gl_FragColor.a < 0.5 : length(gl_PointCoord - 0.5) > 0.5) discard;
}`;

function makeProgram(gl) {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.bindAttribLocation(program, 0, "position");
  gl.bindAttribLocation(program, 1, "uv");
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  return program;
}

/** A rectangle in the scene with a picture, upright. */
class Board {
  /** @param pixels width and height of the picture, a canvas that is painted by `paint`. */
  constructor(gl, pixels) {
    this.gl = gl;
    this.canvas = Object.assign(document.createElement("canvas"), pixels);
    this.corners = gl.createBuffer();
    this.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  }

  /** Put its middle [m] somewhere, its width [m] along a horizontal direction (x, z). */
  place(middle, right, { width, height }) {
    const corners = [];
    for (const [u, v] of [[0, 0], [1, 0], [0, 1], [1, 1]]) {
      const across = (u - 0.5) * width;
      corners.push(
        middle[0] + right[0] * across, middle[1] + (v - 0.5) * height,
        middle[2] + right[1] * across, u, v,
      );
    }
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.corners);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, new Float32Array(corners), this.gl.DYNAMIC_DRAW);
  }

  paint(paint) {
    const { gl } = this;
    paint(this.canvas.getContext("2d"));
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, this.canvas);
  }

  draw() {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.corners);
    gl.enableVertexAttribArray(0);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 20, 0);
    gl.vertexAttribPointer(1, 2, gl.FLOAT, false, 20, 12);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }
}

function paintDisc(context) {
  const { width, height } = DISC_PIXELS;
  context.fillStyle = "#c81e1e";
  context.beginPath();
  context.arc(width / 2, height / 2, width / 2, 0, 2 * Math.PI);
  context.fill();
  context.fillStyle = "#ffffff";
  context.textAlign = "center";
  context.font = "bold 72px system-ui, sans-serif";
  context.fillText("STOP", width / 2, height / 2 + 26, width);
}

export class Scene {
  /** @param describe returns [{ text, colour: [r, g, b], side }] for the panel and the joints. */
  constructor(describe) {
    this.describe = describe;
  }

  /** Make what the session draws with; called once for each session. */
  prepare(session) {
    const canvas = document.createElement("canvas");
    const gl = canvas.getContext("webgl", { xrCompatible: true, alpha: true });
    if (!gl) throw new Error("this browser has no WebGL");
    this.gl = gl;
    this.program = makeProgram(gl);
    this.points = gl.createBuffer();
    gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, true);
    this.panel = new Board(gl, PIXELS);
    this.disc = new Board(gl, DISC_PIXELS);
    this.disc.paint(paintDisc);
    this.painted = -Infinity;
    this.hasPlace = false;
    session.updateRenderState({ baseLayer: new XRWebGLLayer(session, gl) });
  }

  /** Draw a frame for its viewer's pose, if that is known. */
  draw(frame, pose, hands, stopButton) {
    const { gl } = this;
    const layer = frame.session.renderState.baseLayer;
    if (!pose || !layer) return;
    const states = this.describe();
    if (!this.hasPlace) this.placePanel(pose.transform.matrix);
    const size = 2 * stopButton.radius;
    if (stopButton.middle) {
      this.disc.place(stopButton.middle, stopButton.right, { width: size, height: size });
    }
    if (performance.now() - this.painted > PANEL_PERIOD) this.paint(states);
    gl.bindFramebuffer(gl.FRAMEBUFFER, layer.framebuffer);
    const isClear = frame.session.environmentBlendMode !== "opaque";
    gl.clearColor(0.07, 0.09, 0.12, isClear ? 0 : 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.useProgram(this.program);
    const uniform = (name) => gl.getUniformLocation(this.program, name);
    for (const view of pose.views) {
      const { x, y, width, height } = layer.getViewport(view);
      gl.viewport(x, y, width, height);
      gl.uniformMatrix4fv(uniform("projection"), false, view.projectionMatrix);
      gl.uniformMatrix4fv(uniform("view"), false, view.transform.inverse.matrix);
      gl.uniform1f(uniform("size"), 0.5 * POINT_SIZE * height);
      gl.uniform1i(uniform("isBoard"), 0);
      for (const { side, colour } of states) {
        if (!hands[side]) continue;
        gl.uniform4f(uniform("colour"), ...colour, 1);
        this.drawPoints(hands[side]);
      }
      gl.uniform1i(uniform("isBoard"), 1);
      this.panel.draw();
      if (stopButton.middle) this.disc.draw();
    }
  }

  drawPoints(joints) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.points);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(joints.flat()), gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.disableVertexAttribArray(1);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.drawArrays(gl.POINTS, 0, joints.length);
  }

  /** Put the panel in front of the viewer, upright, where it then stays. */
  placePanel(viewer) {
    const [sideX, sideZ] = [viewer[0], viewer[2]];
    const norm = Math.hypot(sideX, sideZ) || 1;
    const right = [sideX / norm, sideZ / norm];
    const middle = [
      viewer[12] + right[1] * PANEL.distance, viewer[13] - PANEL.drop,
      viewer[14] - right[0] * PANEL.distance,
    ];
    this.panel.place(middle, right, PANEL);
    this.hasPlace = true;
  }

  paint(states) {
    this.panel.paint((context) => {
      context.fillStyle = "#1b212b";
      context.fillRect(0, 0, PIXELS.width, PIXELS.height);
      context.font = "52px system-ui, sans-serif";
      states.forEach(({ text, colour }, row) => {
        context.fillStyle = `rgb(${colour.map((value) => Math.round(255 * value)).join(",")})`;
        text.forEach((line, i) => context.fillText(line, 40, 80 + 180 * row + 60 * i, PIXELS.width - 80));
      });
    });
    this.painted = performance.now();
  }
}
