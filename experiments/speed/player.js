// Programs that `player.py` runs in the page of the player, as an object by name.
({
  // Prepares both players; `window.frames.ours` and `.gsplat` draw frame number k.
  setUp: async ([source, size, time]) => {
    const header = JSON.parse(document.getElementById("header").textContent);
    const buffer = bytesOf(document.getElementById("data").textContent);
    const count = header.arrays.color.shape[0];
    const first = viewOf(header.view);
    const viewAt = (k) => orbited(first, header.up, 0.1 * Math.sin(k), 0);
    const cameraAt = (k) => cameraOf(viewAt(k), header.view, size, size);
    const finish = (gl) => {
      const pixels = new Uint8Array(4);
      gl.readPixels(size >> 1, size >> 1, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    };
    const { painter } = player, black = [0, 0, 0];
    const scale = Math.max(1, cameraAt(0).enlarged) ** 2;
    const raster = { ...header.raster, eps2d: header.raster.eps2d * scale };
    const text = document.getElementById("splats").textContent;
    const ask = sorterFor(header, buffer, text, (rows) => painter.sort(rows));
    window.frames = { ours(k) {
      const camera = cameraAt(k);
      ask({ position: camera.position, forward: camera.rotation.slice(6), time });
      painter.draw(camera, raster, time, black);
      finish(painter.gl);
    } };
    frames.ours(0);
    const result = { gaussians: count, moving: painter.scene.movers };
    if (!source) return result;
  
    const url = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
    const { Scene, Camera, WebGLRenderer, Splat, SplatData, Vector3, Quaternion } =
      await import(url);
    const now = {};
    for (const name of Object.keys(FIELDS)) {
      const field = fieldOf(name, header, buffer);
      now[name] = field.values.slice();
      pose(field, time, header.instants, now[name]);
    }
    const color = decoded(header.arrays.color, buffer);
    const colors = new Uint8Array(4 * count);
    for (let i = 0; i < count; i++) {
      for (let k = 0; k < 3; k++) {
        colors[4 * i + k] = Math.round(255 * Math.min(1, color[3 * i + k]));
      }
      colors[4 * i + 3] = Math.round(255 * now.opacity[i]);
      const q = unit(Array.from(now.quaternion.subarray(4 * i, 4 * i + 4)));
      now.quaternion.set(q, 4 * i);
    }
    const canvas = document.createElement("canvas");
    canvas.width = canvas.height = size;
    const renderer = new WebGLRenderer(canvas, []); // no fading in
    renderer.setSize(size, size);
    const scene = new Scene(), camera = new Camera();
    scene.addObject(new Splat(new SplatData(
      count, now.mean, now.quaternion, now.log_scale.map(Math.exp), colors)));
    frames.gsplat = (k) => {
      const [w, x, y, z] = viewAt(k).quaternion, { position, focal } = cameraAt(k);
      camera.data.fx = camera.data.fy = focal;
      camera.position = new Vector3(...position);
      camera.rotation = new Quaternion(-x, -y, -z, w);
      renderer.render(scene, camera);
      finish(renderer.gl);
    };
    const rest = () => new Promise((done) => setTimeout(done, 50));
    for (let i = 0; renderer.renderProgram.depthIndex.length < count; i++) {
      if (i > 600) throw new Error("gsplat.js has not sorted after half a minute");
      frames.gsplat(0);
      await rest();
    }
    for (let i = 0; i < 5; i++) { // until the orders are those of the view
      for (const draw of Object.values(frames)) draw(0);
      await rest();
    }
    const pixels = [painter.gl, renderer.gl].map((gl, i) => {
      Object.values(frames)[i](0);
      const read = new Uint8Array(4 * size * size);
      gl.readPixels(0, 0, size, size, gl.RGBA, gl.UNSIGNED_BYTE, read);
      return read;
    });
    let error = 0;
    for (let i = 0; i < pixels[0].length; i++) {
      if (i % 4 < 3) error += (pixels[0][i] - pixels[1][i]) ** 2;
    }
    result.alike_db = 10 * Math.log10(255 ** 2 / (error / (3 * size * size)));
    return result;
  },

  // Milliseconds of each frame, drawn one after the other.
  draw: async ([name, start, count]) => {
    const times = [];
    for (let k = start; k < start + count; k++) {
      const began = performance.now();
      frames[name](k);
      times.push(performance.now() - began);
      await new Promise((done) => setTimeout(done)); // orders arrive between frames
    }
    return times;
  },

  // Counts fragments by adding a one for each, and times the sort.
  work: ([width, height, time, large]) => {
    const header = JSON.parse(document.getElementById("header").textContent);
    const buffer = bytesOf(document.getElementById("data").textContent);
    const { painter } = player, { gl } = painter;
    const camera = cameraOf(viewOf(header.view), header.view, width, height);
    const raster = { ...header.raster };
    raster.eps2d *= Math.max(1, camera.enlarged) ** 2;
    gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
    gl.activeTexture(gl.TEXTURE0 + 9);
    const texture = newTexture(gl);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, width, height);
    gl.framebufferTexture2D(
      gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    gl.viewport(0, 0, width, height);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    const one = FRAGMENT.replace(/if \(left < 0.0\) discard;/, "")
      .replace(/drawn = .*;/, "drawn = vec4(1.0, left < 0.0 ? 0.0 : 1.0, 0.0, 0.0);");
    const counter = programOf(gl, VERTEX, one);
    const sort = sorterOf(header, buffer), forward = camera.rotation.slice(6);
    const rows = sort({ position: camera.position, forward, time });
    painter.sort(rows);
    painter.project(camera, raster, time);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(counter);
    uniformsOf(gl, counter)("size", "2f", width, height);
    uniformsOf(gl, counter)("least", "1f", raster.alpha_threshold);
    painter.drawQuads();
    const read = new Float32Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, read);
    let shaded = 0, blended = 0;
    for (let i = 0; i < read.length; i += 4) {
      shaded += read[i];
      blended += read[i + 1];
    }
    const median = (run) => {
      const times = Array.from({ length: 21 }, () => {
        const began = performance.now();
        run();
        return performance.now() - began;
      });
      return times.sort((a, b) => a - b)[10];
    };
    const depths = Float32Array.from({ length: large }, () => 1 + Math.random());
    return {
      drawn: rows.length, shaded, blended,
      sort_ms: median(() => sort({ position: camera.position, forward, time })),
      large_sort_ms: median(() => order(depths)),
    };
  },
})
