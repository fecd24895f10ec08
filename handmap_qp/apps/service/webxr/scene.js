// What the headset shows: the joints of both hands, and a panel with the state of each.

const PANEL = { width: 0.75, height: 0.25, distance: 1.0, drop: -0.1 }; // [m]
const PIXELS = { width: 1152, height: 384 };
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
uniform sampler2D panel;
uniform vec4 colour;
uniform bool isPanel;
varying vec2 place;
void main() {
  gl_FragColor = isPanel ? texture2D(panel, place) : colour;
  if (!isPanel && length(gl_PointCoord - 0.5) > 0.5) discard;
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

export class Scene {
  /** @param describe returns [{ text, colour: [r, g, b], side }] for the panel and the joints. */
  constructor(describe) {
    this.describe = describe;
    this.text = Object.assign(document.createElement("canvas"), PIXELS);
  }

  /** Make what the session draws with; called once for each session. */
  prepare(session) {
    const canvas = document.createElement("canvas");
    const gl = canvas.getContext("webgl", { xrCompatible: true, alpha: true });
    if (!gl) throw new Error("this browser has no WebGL");
    this.gl = gl;
    this.program = makeProgram(gl);
    this.points = gl.createBuffer();
    this.panel = gl.createBuffer();
    this.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, true);
    this.painted = -Infinity;
    this.hasPlace = false;
    session.updateRenderState({ baseLayer: new XRWebGLLayer(session, gl) });
  }

  draw(frame, space, hands) {
    const { gl } = this;
    const layer = frame.session.renderState.baseLayer;
    const pose = frame.getViewerPose(space);
    if (!pose || !layer) return;
    const states = this.describe();
    if (!this.hasPlace) this.placePanel(pose.transform.matrix);
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
      gl.uniform1i(uniform("isPanel"), 0);
      for (const { side, colour } of states) {
        if (!hands[side]) continue;
        gl.uniform4f(uniform("colour"), ...colour, 1);
        this.drawPoints(hands[side]);
      }
      gl.uniform1i(uniform("isPanel"), 1);
      this.drawPanel();
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

  drawPanel() {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.panel);
    gl.enableVertexAttribArray(0);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 20, 0);
    gl.vertexAttribPointer(1, 2, gl.FLOAT, false, 20, 12);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
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
    const corners = [];
    for (const [u, v] of [[0, 0], [1, 0], [0, 1], [1, 1]]) {
      const across = (u - 0.5) * PANEL.width;
      corners.push(
        middle[0] + right[0] * across, middle[1] + (v - 0.5) * PANEL.height,
        middle[2] + right[1] * across, u, v,
      );
    }
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.panel);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, new Float32Array(corners), this.gl.STATIC_DRAW);
    this.hasPlace = true;
  }

  paint(states) {
    const { gl } = this;
    const context = this.text.getContext("2d");
    context.fillStyle = "#1b212b";
    context.fillRect(0, 0, PIXELS.width, PIXELS.height);
    context.font = "52px system-ui, sans-serif";
    states.forEach(({ text, colour }, row) => {
      context.fillStyle = `rgb(${colour.map((value) => Math.round(255 * value)).join(",")})`;
      text.forEach((line, i) => context.fillText(line, 40, 70 + 175 * row + 60 * i, PIXELS.width - 80));
    });
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, this.text);
    this.painted = performance.now();
  }
}
