// The page: brings together scene, tool, session, picture and readings.

import { Body } from "./body.js";
import { Camera } from "./camera.js";
import { roundUp } from "./colours.js";
import { Readings, digits } from "./readings.js";
import { Player, Recording } from "./recording.js";
import { Refused, getArrays, getJson, postForArrays } from "./service.js";
import { Session } from "./session.js";
import { Task, exampleTask } from "./task.js";
import { Tool } from "./tool.js";
import { add, across, cross, dot, norm, scale, unit } from "./vectors.js";
import { MOST_PARTS, View } from "./view.js";

const COLOURINGS = ["stress", "displacement", "plain"];
const MOVING = 0.3; // s after which a picture that has not changed stands still
const SLOW = 0.045; // s a frame, from which on fewer pixels are drawn
const BLURRED = 0.6; // pixels for each of the screen, from which on they are not fewer
const COLOURED = 0.05; // s between fields of stress, which cost the service most of an answer
const MEASURED = 0.1; // s between largest stresses, which cost as much
const STILL = 15; // s after which a position is sent again, so that the session does not end
const CHECKED = 0.25; // s between comparisons of the two fields
const NEAR = 3; // local models whose modes are fetched as the tip comes near
const LISTED = 5; // s between looks for scenes that have been added or removed
const FAR = 1; // of the body's radius, from its surface: positions beyond are not its own
const LOGGED = 2000; // answers that are remembered for tests and for people who look
const TRAINED = 0.5; // share of the range that the level begins with, at most
const SAFE = 0.9; // of the least depth limit, the same
const BUSY = [429, 503]; // statuses after which modes are asked for again

const element = (id) => document.getElementById(id);
const seconds = () => performance.now() / 1000;
const arrow = (force, most, radius) => scale(force, (3 * radius) / most);

class Page {
  constructor() {
    this.camera = new Camera();
    this.view = new View(element("canvas"));
    this.readings = new Readings();
    this.tool = new Tool(element("canvas"), this.camera, {
      view: () => { this.changed = true; this.tell(); },
      level: () => this.showLevel(),
    });
    this.log = [];
    this.recording = this.recorded = this.player = this.task = null;
    this.fetching = new Set();
    this.dark = matchMedia("(prefers-color-scheme: dark)");
    this.dark.onchange = () => { this.changed = true; };
    this.listen();
    this.last = seconds();
    this.sharpness = 1; // pixels drawn for each of the screen
    this.pace = 0; // s a frame, of late
    this.movedAt = 0;
    requestAnimationFrame(() => this.frame());
  }

  listen() {
    element("scene").onchange = (event) => this.open(event.target.value);
    element("colouring").onchange = () => { this.changed = true; this.tell(); };
    element("whole").onclick = () => this.lookAtAll();
    element("level").oninput = (event) => this.tool.setLevel(Number(event.target.value));
    for (const id of ["tilt", "towards"]) element(id).oninput = () => this.showLevel();
    element("young").oninput = () => this.stiffen();
    element("keep").onchange = ({ target }) => {
      this.tool.keeps = target.checked;
      if (!target.checked) this.tool.held = false;
      this.tell();
    };
    element("lock").onchange = () => { this.changed = true; this.tell(); };
    element("range").onchange = () => { element("lock").checked = true; this.changed = true; this.tell(); };
    element("server-field").onchange = () => { this.sentAt = null; this.tell(); };
    element("bare").onchange = () => { this.changed = true; };
    element("snapshot").onclick = () => { this.session?.command("snapshot"); element("restore").disabled = false; };
    element("restore").onclick = () => { this.session?.command("restore"); this.sentAt = null; };
    element("record").onclick = () => this.record();
    for (const kind of ["csv", "h5"]) element(`save-${kind}`).onclick = () => this.save(kind);
    element("play").onchange = ({ target }) => this.play(target.files[0]);
    element("task").onchange = ({ target }) => this.set(target.files[0]);
    element("again").onclick = () => { this.task.again(); this.showTask(); };
    element("replay").onclick = () => this.play(new File([this.recorded.csv()], "Recording"));
    element("example").onclick = () => this.scene && this.set(
      new File([exampleTask(this.body, this.young, this.scene.ranges.radius)], "Example"),
    );
    element("stop").onclick = () => this.stop();
    document.addEventListener("dragover", (event) => event.preventDefault());
    document.addEventListener("drop", (event) => {
      event.preventDefault();
      const [file] = event.dataTransfer.files;
      if (file?.name.endsWith(".json")) this.set(file);
      else this.play(file);
    });
    document.addEventListener("visibilitychange", () => {
      this.last = seconds();
      this.changed = true;
    });
    window.addEventListener("hashchange", () => {
      if (location.hash.slice(1) !== this.told) this.follow();
    });
    element("canvas").addEventListener("webglcontextlost", (event) => event.preventDefault());
    element("canvas").addEventListener("webglcontextrestored", () => location.reload());
  }

  /** Begin: list the scenes, and open the one in the address or the first. */
  async begin() {
    for (;;) {
      try {
        const { scenes, refused } = await this.list();
        if (scenes.length) break;
        this.say(`No scene is served yet. ${refused.map((r) => r.reason).join(" ")}`);
      } catch (error) {
        this.linked("waiting", error.code === "not_ready"
          ? "The models are being loaded …" : `${error.message} Trying again …`);
      }
      await new Promise((done) => { setTimeout(done, 1000); });
    }
    setInterval(() => document.hidden || this.list().catch(() => {}), 1000 * LISTED);
    await this.follow();
  }

  /** Offer the scenes that are served now. */
  async list() {
    const found = await getJson("scenes"), select = element("scene");
    const offered = [...select.options].map(({ value }) => value);
    if (found.scenes.map(({ name }) => name).join() !== offered.join()) {
      select.replaceChildren(...found.scenes.map(({ name, description }) => (
        Object.assign(new Option(name), { title: description })
      )));
      if (this.name) select.value = this.name;
    }
    element("training").textContent = found.training.map(({ scene, stage, share, seconds_left }) => (
      `${found.scenes.some(({ name }) => name === scene) ? "A newer model of " : ""}${scene} is being trained: ${Math.round(100 * share)} %, ${stage}${
        seconds_left === null ? "" : `, about ${Math.ceil(seconds_left / 60)} min left`}`
    )).join("; ");
    return found;
  }

  /** Do what the address says. */
  async follow() {
    const said = new URLSearchParams(location.hash.slice(1));
    const names = [...element("scene").options].map((option) => option.value);
    const wanted = said.get("scene") ?? names[0];
    element("colouring").value = COLOURINGS.includes(said.get("colours")) ? said.get("colours") : "stress";
    element("lock").checked = said.has("range");
    if (said.has("range")) element("range").value = said.get("range");
    element("server-field").checked = said.get("field") === "server";
    await this.open(wanted, said);
  }

  /** Open a scene; `said` is what the address says of the view and the tool. */
  async open(name, said = new URLSearchParams()) {
    this.session?.close();
    this.session = this.scene = null;
    this.opening = name;
    this.linked("waiting", "Loading …");
    const path = `scenes/${encodeURIComponent(name)}`;
    try {
      const [scene, mesh, accessible] = await Promise.all([
        getJson(path), getArrays(`${path}/mesh`), getArrays(`${path}/accessible`),
      ]);
      const sessions = scene.serves.sessions;
      const centres = sessions ? (await getArrays(`${path}/modes`)).arrays.centres : null;
      if (this.opening !== name) return;
      Object.assign(this, { name, scene, centres, broken: "" });
      this.show(new Body(mesh, accessible), said);
    } catch (error) {
      if (this.opening !== name) return;
      element("scene").value = name; // blank where it is not served
      this.linked("refused", "");
      this.say(error instanceof Refused ? `Scene ${name}: ${error.message}` : String(error));
      if (!error.status) setTimeout(() => this.opening === name && this.open(name, said), 1000);
    }
  }

  show(body, said) {
    const { scene } = this, sessions = scene.serves.sessions;
    this.say("");
    this.changed = true;
    element("scene").value = this.name;
    document.body.classList.toggle("with-tip", sessions);
    document.body.classList.toggle("with-load", !sessions);
    document.body.classList.toggle("with-time", sessions && scene.serves.histories);
    element("restore").disabled = true;
    element("tilt").max = scene.ranges.tilt[1];
    element("about").textContent = scene.description;
    this.body = body;
    this.view.setBody(body);
    this.readings.clear();
    this.log.length = 0;
    this.player = null;
    element("stop").hidden = true;
    if (this.recording) this.record(); // of another scene
    element("replay").hidden = this.recorded?.scene !== this.name;
    this.task = null;
    this.showTask();
    Object.assign(this, { answer: null, sentAt: null, placed: null, checkedAt: 0, stress: null, colouredAt: 0, measuredAt: 0 });
    this.readings.answer = null;
    const most = sessions
      ? Math.min(1.25 * scene.ranges.depth[1], 0.95 * scene.ranges.radius) : 1.25 * scene.ranges.pressure[1];
    this.tool.reset(body, Math.min((TRAINED * most) / 1.25, sessions ? SAFE * body.leastDepth : Infinity), most);
    this.tool.keeps = element("keep").checked;
    element("level").max = most;
    this.ratio = 1;
    element("young").value = said.get("young") ?? 0;
    this.stiffen();
    this.fit(1);
    if (!this.camera.fromText(said.get("view") ?? "")) this.lookAtAll();
    const tool = (said.get("tool") ?? "").split(",").map(Number);
    if (tool.length === 4 && tool.every(Number.isFinite)) {
      this.tool.place = body.touchNear(tool.slice(0, 3), true);
      this.tool.held = Boolean(this.tool.place);
      element("keep").checked = this.tool.keeps = this.tool.held;
      this.tool.setLevel(tool[3]);
    }
    this.showLevel();
    if (sessions) {
      this.connect();
    } else {
      this.linked("open", "");
    }
  }

  /** Begin a session. */
  connect() {
    this.session?.close();
    this.session = new Session(this.name, {
      greeting: (greeting) => this.greeted(greeting),
      reply: (reply, trip, frames) => this.replied(reply, trip, frames),
      obeyed: (command, value) => this.recording?.obeyed(command, value),
      state: (state, words) => this.linked(state, words),
    });
  }

  /** A session is open; where the scene has been trained anew, its body is another. */
  greeted(greeting) {
    this.sentAt = null;
    if (this.recording) this.recording.greeting ??= greeting;
    if (this.ratio !== 1) this.session.command("young", this.young);
    if (greeting.artifact !== this.scene.artifact) this.open(this.name, new URLSearchParams(this.told));
  }

  linked(state, words) {
    const link = element("link"), plain = { open: "connected", waiting: "connecting", refused: "refused" };
    link.dataset.state = state;
    link.textContent = plain[state];
    this.say(words);
    if (state !== "open") this.sentAt = null;
  }

  /** Show a sentence over the picture, or take it away. */
  say(words) {
    element("message").hidden = !words;
    element("message").textContent = words;
  }

  lookAtAll() {
    this.camera.frame(this.body.centre, this.body.radius, this.body.outward);
    this.changed = true;
    this.tell();
  }

  /** Write the state into the address, soon. */
  tell() {
    clearTimeout(this.telling);
    this.telling = setTimeout(() => {
      if (!this.scene) return;
      const said = new URLSearchParams({ scene: this.name, view: this.camera.toText() });
      if (element("colouring").value !== "stress") said.set("colours", element("colouring").value);
      if (element("lock").checked) said.set("range", element("range").value);
      if (element("server-field").checked) said.set("field", "server");
      if (this.ratio !== 1) said.set("young", element("young").value);
      const { held, place, level } = this.tool;
      if (held && place) said.set("tool", [...place.point, level].map((x) => x.toFixed(3)).join());
      this.told = said.toString();
      history.replaceState(null, "", `#${this.told}`);
    }, 300);
  }

  /** Young's modulus (kPa) that the slider is set to: in its middle that of the training. */
  get young() {
    return this.scene.young * 10 ** Number(element("young").value);
  }

  /** Make the tissue as stiff as the slider says; a footprint presses as much harder. */
  stiffen() {
    if (!this.scene) return;
    const ratio = this.young / this.scene.young;
    if (!this.scene.serves.sessions) {
      this.tool.most *= ratio / this.ratio;
      element("level").max = this.tool.most;
      this.tool.setLevel((this.tool.level * ratio) / this.ratio);
    }
    this.ratio = ratio;
    this.session?.command("young", this.young);
    this.sentAt = null;
    this.showLevel();
  }

  showLevel() {
    if (!this.scene) return;
    element("young-value").textContent = `${digits(this.young)} kPa`;
    const { sessions } = this.scene.serves, { level } = this.tool;
    element("level-name").textContent = sessions ? "Depth" : "Pressure";
    element("level").value = level;
    element("level-value").textContent = `${digits(level)} ${sessions ? "mm" : "kPa"}`;
    for (const id of ["tilt", "towards"]) element(`${id}-value`).textContent = `${element(id).value}°`;
    this.tell();
  }

  frame() {
    requestAnimationFrame(() => this.frame());
    const now = seconds(), passed = Math.min(now - this.last, 0.1);
    this.last = now;
    if (document.hidden || !this.scene) return;
    const before = this.tool.now;
    if (this.player) this.playOn(now);
    else this.tool.step(passed, !this.scene.serves.sessions);
    const place = this.tool.place;
    if (before !== this.tool.now || place !== this.placed) this.changed = true;
    this.placed = place;
    if (this.scene.serves.sessions) this.ask(now);
    else this.press(now);
    if (this.changed) {
      if (now - this.movedAt < MOVING) this.keepUp(passed);
      this.movedAt = now;
    }
    const resized = this.fit(now - this.movedAt < MOVING ? this.sharpness : 1);
    if (this.changed || resized) {
      this.changed = false;
      this.draw();
      this.readings.countFrame(now);
    }
    if (!this.session || this.session.reader) this.opened ??= now; // s since the address was given
    this.readings.show(now, this.scene.tolerance, this.level(), this.tool.beyond);
  }

  /** Draw fewer pixels where it takes too long to follow the hand. */
  keepUp(passed) {
    this.pace += 0.1 * (passed - this.pace);
    if (this.pace < SLOW || this.sharpness <= BLURRED) return;
    this.sharpness *= 0.8;
    this.pace = 0;
  }

  /** Make the canvas so much finer than the screen; return whether it has changed. */
  fit(sharpness) {
    const resized = this.view.fit(sharpness), { width, height } = this.view.canvas;
    this.camera.aspect = width / height;
    return resized;
  }

  /** What the tool is set to and has reached, for the readings. */
  level() {
    const { answer, tool, scene } = this, { sessions } = scene.serves;
    const value = answer ? Math.max(sessions ? answer.depth : answer.pressure, 0) : 0;
    const limit = sessions ? answer?.depth_limit || tool.place?.depthLimit : answer?.pressure_limit || this.ratio * tool.place?.pressureLimit;
    return {
      name: sessions ? "Depth" : "Pressure",
      unit: sessions ? "mm" : "kPa", value, limit: limit ?? 0, most: tool.most,
      error: value > 0 ? answer.errors.displacement : null,
    };
  }

  // A tip, by a session.

  /** Ask for the answer where the tip is, if there is anything new to ask. */
  ask(now) {
    const { tool, session, scene } = this;
    if (!session?.ready) return;
    if (tool.place) this.approach(tool.place.point);
    let position = null;
    if (this.player) position = this.played;
    else if (tool.place && tool.now > AWAY_ENOUGH) position = tool.centre(scene.ranges.radius);
    else if (this.sentAt) position = this.lifted;
    if (tool.place) this.lifted = add(tool.place.point, tool.place.normal, scene.ranges.radius + 1);
    if (!position) return;
    const same = this.sentAt && norm(add(position, this.sentAt, -1)) === 0;
    const still = same && !this.answer?.CLAMPED && now - this.sentTime < STILL;
    const faded = now - this.colouredAt >= COLOURED;
    if (still && !scene.serves.histories && !this.wanted && !(this.pale && faded)) return;
    const server = element("server-field").checked;
    const outputs = ["PARTS"];
    if (faded) outputs.push("VON_MISES");
    if (now - this.measuredAt >= MEASURED) outputs.push("STRESS");
    if (server || !this.shaped) outputs.push("DISPLACEMENT");
    else outputs.push("HALF");
    this.wanted = false;
    Object.assign(this, { asked: position, sentAt: position, sentTime: now });
    session.send(position, outputs);
  }

  replied(reply, trip, frames) {
    const now = seconds();
    this.pale = !(reply.stress && reply.measured);
    if (reply.stress) this.colouredAt = now;
    if (reply.measured) this.measuredAt = now;
    const stress = reply.stress ?? this.stress;
    const largest = reply.measured ? reply.max_von_mises : this.answer?.largest_stress;
    const answer = {
      ...reply, tip: true, stress, trip_ms: trip, solve_ms: 1e3 * reply.solve_time, largest_stress: largest,
      errors: {
        force: reply.CONTACT ? reply.error_force : null,
        displacement: reply.error_displacement, von_mises: reply.error_von_mises,
      },
    };
    this.answered(answer, now, this.asked);
    if (this.recording) {
      this.recording.take(now, this.asked, reply, frames);
      element("record").textContent = `Stop after ${this.recording.rows.length} answers`;
    }
    this.shape(reply, now);
  }

  /** Begin to record, with a session of its own, or end it; then it can be saved. */
  record() {
    if (this.recording) {
      this.recorded = this.recording.rows.length ? this.recording : this.recorded;
      this.recording = null;
    } else {
      this.recording = new Recording(this.name, seconds());
      this.connect();
    }
    element("record").textContent = this.recording ? "Stop recording" : "Record";
    element("save").hidden = !this.recorded;
    element("replay").hidden = this.recorded?.scene !== this.name;
  }

  /** Save what has been recorded, as "csv" or as "h5". */
  async save(kind) {
    try {
      const address = URL.createObjectURL(await this.recorded[kind]());
      const link = { href: address, download: `${this.recorded.scene}.${kind}` };
      Object.assign(document.createElement("a"), link).click();
      setTimeout(() => URL.revokeObjectURL(address), 10000);
    } catch (error) {
      this.say(error.message);
    }
  }

  /** Use the text of a file that was chosen with an element, or say what is wrong with it. */
  async take(file, id, use) {
    if (!file) return;
    try {
      use(await file.text());
      this.say("");
    } catch (error) {
      this.say(`${file.name}: ${error.message}`);
    }
    element(id).value = "";
  }

  /** Set a task, which is a JSON file. */
  set(file) {
    return this.take(file, "task", (text) => {
      this.task = new Task(text, (point) => this.body.gap(point), this.scene.ranges.radius);
      this.showTask();
    });
  }

  /** Play a recording: the tip goes where it was, and the tissue answers anew. */
  play(file) {
    return this.take(file, "play", (text) => {
      if (!this.scene?.serves.sessions) throw new Error("Only scenes with a tip play recordings.");
      const { body } = this, away = (point) => norm(add(point, body.centre, -1));
      // far beyond the ball round the body nothing need be searched for
      this.player = new Player(text, (point) => (
        away(point) < (1 + FAR) * body.radius && body.gap(point) < FAR * body.radius
      ));
      this.playedSince = seconds();
      this.tool.held = false;
      element("stop").hidden = false;
    });
  }

  /** Play no more. */
  stop() {
    this.player = this.tool.place = null;
    this.tool.now = -1;
    element("stop").hidden = true;
  }

  /** Let the task know where the tool touches (null if it does not) and its force. */
  score(now, point, force) {
    if (!this.task) return;
    this.task.take(now, point, force);
    this.showTask();
  }

  /** Show how a task stands. */
  showTask() {
    element("again").hidden = !this.task;
    element("score").textContent = this.task?.words() ?? "";
    element("score").dataset.state = this.task?.state ?? "";
    this.changed = true;
  }

  /** Put the tool where the recording that is played has it now. */
  playOn(now) {
    const { tool, body, scene } = this, position = this.player.at(now - this.playedSince);
    this.played = position;
    if (!position) {
      this.stop();
      return;
    }
    element("stop").textContent = `Stop, ${(now - this.playedSince).toFixed(1)} of ${this.player.length.toFixed(1)} s`;
    tool.place = body.touchNear(position);
    if (!tool.place) return;
    const { point, normal } = tool.place;
    tool.now = scene.ranges.radius - dot(add(position, point, -1), normal);
  }

  /** Show the displacement of a reply: by its parts if their modes are here, else the server's. */
  shape(reply, now) {
    const { view } = this, { parts, displacement } = reply, models = [...parts.models];
    models.forEach((k) => this.fetchModes(k));
    const possible = view.has(models) && models.length <= MOST_PARTS;
    this.shaped = possible;
    if (!possible) this.wanted = true; // now from the server, and as soon as the modes are here
    const server = element("server-field").checked;
    try {
      if (possible) view.showParts(parts);
      if (possible && server && displacement && now - this.checkedAt > CHECKED) {
        this.checkedAt = now;
        this.compare(view.readBack(), displacement);
      }
    } catch (error) {
      this.fail(error);
    }
    if (displacement && (server || !possible)) view.showField(displacement);
    if (!server) element("difference").textContent = this.broken;
  }

  /** Say by how much the shader's displacement differs from the server's. */
  compare(own, server) {
    let most = 0, apart = 0;
    for (let i = 0; i < own.length; i += 3) {
      most = Math.max(most, Math.hypot(server[i], server[i + 1], server[i + 2]));
      apart = Math.max(apart, Math.hypot(own[i] - server[i], own[i + 1] - server[i + 1], own[i + 2] - server[i + 2]));
    }
    this.compared = most > 0 ? apart / most : 0;
    element("difference").textContent = `Shown as the service sent it; as the picture makes it, it differs by at most ${(100 * this.compared).toPrecision(2)} % of the largest.`;
  }

  /** Fetch the modes of the local models nearest to a point. */
  approach(point) {
    if (this.approached && norm(add(point, this.approached, -1)) < 0.2) return;
    this.approached = point;
    const distance = (k) => norm(add([...this.centres.subarray(3 * k, 3 * k + 3)], point, -1));
    const near = Array.from({ length: this.centres.length / 3 }, (_, k) => k);
    near.sort((a, b) => distance(a) - distance(b)).slice(0, NEAR).forEach((k) => this.fetchModes(k));
  }

  async fetchModes(number) {
    const { scene, view, name } = this, key = `${scene.artifact} ${number}`;
    if (this.broken || !view.canHoldModes || view.has([number]) || this.fetching.has(key)) return;
    this.fetching.add(key);
    try {
      const path = `scenes/${encodeURIComponent(name)}/modes/${number}?artifact=${scene.artifact}`;
      const { arrays } = await getArrays(path);
      if (this.scene === scene) view.addModes(number, arrays);
    } catch (error) {
      if (BUSY.includes(error.status)) await new Promise((done) => { setTimeout(done, 1000); });
      else if (this.scene === scene) this.fail(error);
    } finally {
      this.fetching.delete(key);
    }
  }

  /** Modes make no sense: go on with the server's field, and say so. */
  fail(error) {
    this.broken = `The modes cannot be used (${error.message}); the displacement shown is the service's.`;
    element("difference").textContent = this.broken;
  }

  // A footprint, by HTTP.

  /** Solve the load that the tool is set to, the newest one first. */
  async press(now) {
    const { tool, name, scene } = this;
    if (this.solving || !(tool.active && tool.place) || now < (this.restUntil ?? 0)) {
      if (!tool.active && this.answer && !this.solving) this.release();
      return;
    }
    const contact = { position: tool.place.point, pressure: tool.level, direction: this.direction() };
    const asked = { contacts: [contact], region: "surface", young: this.young }, key = JSON.stringify(asked);
    if (key === this.pressed) return;
    this.pressed = key;
    this.solving = true;
    const start = performance.now();
    try {
      const { head, arrays } = await postForArrays(`scenes/${encodeURIComponent(name)}/solve`, asked);
      if (this.scene === scene) this.solved(contact, head, arrays, performance.now() - start);
      this.linked("open", "");
    } catch (error) {
      this.restUntil = now + 0.5;
      this.pressed = null;
      if (this.scene === scene) this.linked(error.status ? "open" : "waiting", error.message);
    } finally {
      this.solving = false;
    }
  }

  /** Direction of the load: the inward normal, tilted. */
  direction() {
    const { normal } = this.tool.place, x = across(normal), y = cross(normal, x);
    const [tilt, towards] = ["tilt", "towards"].map((id) => (Number(element(id).value) * Math.PI) / 180);
    const level = add(scale(x, Math.cos(towards)), y, Math.sin(towards));
    return add(scale(normal, -Math.cos(tilt)), level, Math.sin(tilt));
  }

  solved(contact, head, arrays, trip) {
    const errors = head.trust.error_estimate, known = (e) => e ?? Infinity;
    this.answered({
      ...head.contact, force: head.force, CONTACT: contact.pressure > 0, trip_ms: trip,
      contact_point: head.contact.position, solve_ms: head.timing.solve_us / 1e3,
      out_of_range: head.trust.out_of_range, largest_stress: arrays.von_mises.reduce((a, b) => Math.max(a, b), 0),
      errors: { force: null, displacement: known(errors.displacement), von_mises: known(errors.von_mises) },
      stress: arrays.von_mises,
    }, seconds(), contact);
    this.view.showField(arrays.displacement);
  }

  release() {
    this.score(seconds(), null, 0);
    this.answer = this.readings.answer = this.pressed = this.stress = null;
    this.view.showField(null);
    this.view.showStress(null);
    this.changed = true;
  }

  // Both.

  answered(answer, now, asked) {
    this.answer = answer;
    if (answer.stress !== this.stress) this.view.showStress(answer.stress);
    this.stress = answer.stress;
    this.readings.take(answer, now);
    this.score(now, answer.CONTACT ? answer.contact_point : null, norm(answer.force));
    this.log.push({ asked, force: answer.force, position: answer.position, flags: answer.flags });
    if (this.log.length > LOGGED) this.log.shift();
    this.changed = true;
  }

  /** Range and 99th percentile of what the colours show. */
  measure(colouring) {
    if (colouring === "plain") return { range: 1 };
    const { answer } = this, stress = colouring === "stress";
    const name = stress ? "von Mises" : "displacement", unitOf = stress ? "kPa" : "mm";
    let most = 0, mark = 0;
    if (answer && stress) {
      const sorted = Float32Array.from(this.stress).sort();
      mark = sorted[Math.floor(0.99 * (sorted.length - 1))];
      // beyond the largest outside the clamped layer there is only what grows with the mesh's fineness
      most = Math.min(sorted.at(-1), Math.max(answer.largest_stress ?? Infinity, mark));
    } else if (answer) {
      most = Math.max(answer.depth ?? norm(answer.contact_displacement ?? [1, 0, 0]), 0.1);
    }
    const typed = Number(element("range").value);
    if (!(typed > 0)) element("lock").checked = false; // there is no such range
    const range = element("lock").checked ? typed : roundUp(most);
    if (!element("lock").checked && document.activeElement !== element("range")) element("range").value = range;
    element("range-unit").textContent = unitOf;
    return { name, unit: unitOf, range, mark };
  }

  draw() {
    const { answer, tool, scene, readings } = this, colouring = element("colouring").value;
    const { radius } = scene.ranges, legend = this.measure(colouring);
    readings.drawLegend(legend);
    const parts = { tool: null, arrow: null, task: this.task };
    if (tool.place && !element("bare").checked) {
      const axis = scene.serves.sessions || !tool.active ? tool.place.normal : scale(this.direction(), -1);
      const tip = scene.serves.sessions, ghost = !tool.active && tool.now <= 0;
      const centre = tip ? add(tool.place.point, tool.place.normal, radius - Math.max(tool.now, ghost ? 0 : -10)) : tool.place.point;
      parts.tool = { centre, axis, radius, length: 10 * radius, tip, ghost };
    }
    const force = answer?.CONTACT ? answer.force : [0, 0, 0];
    if (norm(force) > 0) {
      const along = arrow(force, roundUp(readings.most.force), radius);
      parts.arrow = { from: answer.contact_point, along, width: 0.07 * radius };
    }
    this.view.draw({
      camera: this.camera, colouring: COLOURINGS.indexOf(colouring), range: legend.range,
      dark: this.dark.matches, ...parts,
    });
  }
}

const AWAY_ENOUGH = -0.999; // mm: a tool as far off as this is not asked about

try {
  window.palpate = new Page();
  await window.palpate.begin();
} catch (error) {
  const said = error.message === "no WebGL2"
    ? "This browser shows no WebGL2, which the picture needs. Switch on hardware acceleration in its settings, update it, or use another; the API works without it."
    : `The page has failed: ${error.message}`;
  element("message").hidden = false;
  element("message").textContent = said;
}
