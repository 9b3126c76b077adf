// The endpoints of the service, from its OpenAPI document.

import { getJson } from "./service.js";

/** An element with text or other elements in it. */
function make(tag, ...content) {
  const made = document.createElement(tag);
  made.append(...content);
  return made;
}

/** The schema that a reference leads to. */
const resolve = (document, schema) => (schema?.$ref
  ? document.components.schemas[schema.$ref.split("/").at(-1)] : schema ?? {});

/** The type of a schema in a few words. */
function type(document, schema) {
  if (schema.$ref) return schema.$ref.split("/").at(-1);
  const options = schema.anyOf ?? schema.oneOf;
  if (options) return options.map((option) => type(document, option)).join(" or ");
  if (schema.enum) return schema.enum.map((value) => JSON.stringify(value)).join(" or ");
  if ("const" in schema) return JSON.stringify(schema.const);
  if (schema.type === "array") return `list of ${type(document, schema.items ?? {})}`;
  return schema.type ?? "anything";
}

/** What a schema says beyond its type: default and limits. */
function limits(schema) {
  const names = {
    default: "default", minimum: "≥", maximum: "≤", exclusiveMinimum: ">", exclusiveMaximum: "<",
    minItems: "items ≥", maxItems: "items ≤",
  };
  return Object.entries(names).filter(([key]) => key in schema)
    .map(([key, name]) => `${name} ${JSON.stringify(schema[key])}`).join(", ");
}

function fields(document, properties, required = []) {
  const rows = Object.entries(properties).map(([name, schema]) => make(
    "tr", make("th", make("code", name), required.includes(name) ? " *" : ""),
    make("td", type(document, schema)), make("td", limits(schema)),
    make("td", schema.description ?? ""),
  ));
  return make("table", make("tbody", ...rows));
}

/** A schema with the schemas that its fields lead to. */
function described(document, schema, seen = new Set()) {
  const found = resolve(document, schema), parts = [];
  if (found.properties) {
    if (schema.$ref) parts.push(make("h4", schema.$ref.split("/").at(-1)));
    if (found.description) parts.push(make("p", found.description));
    parts.push(fields(document, found.properties, found.required));
  }
  for (const text of JSON.stringify(found).matchAll(/"\$ref":"([^"]+)"/g)) {
    if (seen.has(text[1])) continue;
    seen.add(text[1]);
    parts.push(...described(document, { $ref: text[1] }, seen));
  }
  return parts;
}

function endpoint(document, path, method, said) {
  const whole = make("details", make(
    "summary", make("strong", method.toUpperCase()), " ", make("code", path), " ",
    (said.description ?? "").split("\n")[0],
  ));
  const text = (said.description ?? "").split("\n\n").slice(1).join("\n\n");
  if (text) whole.append(make("p", text));
  if (said.parameters?.length) {
    const properties = Object.fromEntries(said.parameters.map((p) => (
      [p.name, { ...p.schema, description: `${p.description ?? ""} (${p.in})` }]
    )));
    const required = said.parameters.filter((p) => p.required).map((p) => p.name);
    whole.append(make("h3", "Parameters"), fields(document, properties, required));
  }
  const body = said.requestBody?.content?.["application/json"]?.schema;
  if (body) {
    whole.append(make("h3", "Request"), ...described(document, body));
    const [example] = resolve(document, body).examples ?? [];
    if (example) whole.append(make("pre", JSON.stringify(example, null, 1)));
  }
  for (const [status, response] of Object.entries(said.responses ?? {})) {
    const formats = Object.keys(response.content ?? {}).join(", ");
    whole.append(make("h3", `${status} `, make("small", formats)));
    if (status === "200" || status === "101") {
      whole.append(make("pre", response.description ?? ""));
      const answer = response.content?.["application/json"]?.schema;
      if (answer) whole.append(...described(document, answer));
    }
  }
  return whole;
}

const place = document.getElementById("endpoints");
try {
  const said = await getJson("openapi.json"), parts = [];
  for (const [path, methods] of Object.entries(said.paths)) {
    for (const [method, about] of Object.entries(methods)) {
      parts.push(endpoint(said, path, method, about));
    }
  }
  place.replaceChildren(
    make("h2", `${said.info.title} ${said.info.version}`), make("p", said.info.description ?? ""),
    make("p", "Fields with * are required."), ...parts,
  );
} catch (error) {
  place.replaceChildren(make("p", error.message));
}
