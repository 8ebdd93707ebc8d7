// Thin helpers over WebGL2: programs with their uniforms, data textures, the target of the splats.

const TEXTURE_WIDTH = 1024;  // of all data textures, as at() in project.vert has it

function compiled(gl, kind, source) {
  const shader = gl.createShader(kind);
  gl.shaderSource(shader, source);
  gl.compileShader(shader);
  return shader;
}

// A program and the places of its uniforms and attributes. `captured` names what transform feedback stores.
function makeProgram(gl, vertex, fragment, captured = []) {
  const source = (name) => document.getElementById(`shader-${name}`).textContent.trim();
  const program = gl.createProgram();
  gl.attachShader(program, compiled(gl, gl.VERTEX_SHADER, source(vertex)));
  const empty = "#version 300 es\nprecision mediump float;\nout vec4 none;\nvoid main() { none = vec4(0); }";
  gl.attachShader(program, compiled(gl, gl.FRAGMENT_SHADER, fragment ? source(fragment) : empty));
  if (captured.length) gl.transformFeedbackVaryings(program, captured, gl.INTERLEAVED_ATTRIBS);
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
    const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
    throw new Error(`${vertex}: ${[gl.getProgramInfoLog(program), ...logs].join("\n")}`);
  }
  const uniforms = {};
  for (let k = 0; k < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); k++) {
    const name = gl.getActiveUniform(program, k).name.replace("[0]", "");
    uniforms[name] = gl.getUniformLocation(program, name);
  }
  return { program, uniforms, attribute: (name) => gl.getAttribLocation(program, name) };
}

const FORMATS = {
  RG32F: ["RG", "FLOAT", 2, Float32Array], RGB32F: ["RGB", "FLOAT", 3, Float32Array],
  RGBA32F: ["RGBA", "FLOAT", 4, Float32Array], RGB16F: ["RGB", "HALF_FLOAT", 3, Uint16Array],
  RGBA16F: ["RGBA", "HALF_FLOAT", 4, Uint16Array], RGB8_SNORM: ["RGB", "BYTE", 3, Int8Array],
  R8: ["RED", "UNSIGNED_BYTE", 1, Uint8Array], R8UI: ["RED_INTEGER", "UNSIGNED_BYTE", 1, Uint8Array],
  R16UI: ["RED_INTEGER", "UNSIGNED_SHORT", 1, Uint16Array],
};

// A texture that holds an array row by row, filled up with zeros. `update` writes new values of the same length.
function makeData(gl, internal, values) {
  const [format, type, channels, Kind] = FORMATS[internal];
  const height = Math.max(1, Math.ceil(values.length / channels / TEXTURE_WIDTH));
  const padded = new Kind(height * TEXTURE_WIDTH * channels), texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl[internal], TEXTURE_WIDTH, height);
  for (const side of ["MIN", "MAG"]) gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${side}_FILTER`], gl.NEAREST);
  const update = (changed) => {
    padded.set(changed);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_WIDTH, height, gl[format], gl[type], padded);
  };
  // Take the first values from a buffer on the GPU instead, which must have `bytes` bytes.
  const copy = (buffer, count) => {
    const rows = Math.ceil(count / channels / TEXTURE_WIDTH);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, buffer);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_WIDTH, rows, gl[format], gl[type], 0);
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, null);
  };
  update(values);
  return { texture, update, copy, bytes: padded.byteLength };
}

// The target of the splats: half floats, since eight bits per blend would add up to visible steps; eight bits only
// where a device cannot draw into half floats.
class Target {
  constructor(gl) {
    this.gl = gl;
    this.internal = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float")
      ? gl.RGBA16F : gl.RGBA8;
    this.framebuffer = gl.createFramebuffer();
  }

  resize(width, height) {
    if (this.width === width && this.height === height) return;
    const { gl } = this;
    gl.deleteTexture(this.texture ?? null);
    this.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.internal, width, height);
    for (const side of ["MIN", "MAG"]) gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${side}_FILTER`], gl.LINEAR);
    for (const side of ["S", "T"]) gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_WRAP_${side}`], gl.CLAMP_TO_EDGE);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.texture, 0);
    Object.assign(this, { width, height });
  }
}
