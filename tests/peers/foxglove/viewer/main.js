"use strict";
// Foxglove Studio in this page: it connects to the `ds.url` of the address and opens the layout `layoutId`.
// layouts.json has the layouts, by name. What a person changes is kept as long as the page is open.

/** Nobody is asked anything, nothing is reported to anybody, and pictures do not depend on the machine. */
const SETTINGS = {
  colorScheme: "dark",
  timezone: "UTC",
  "time.format": "TOD",
  language: "en",
  messageRate: 20,
  hideSignInPrompt: true,
  launchPreference: "web",
  "telemetry.telemetryEnabled": false,
  "telemetry.crashReportingEnabled": false,
  "ui.open-dialog-startup": false,
  "updates.enabled": false,
};

/** Studio's settings, in memory. */
class Settings {
  #values = new Map(Object.entries(SETTINGS));
  #listeners = new Map();

  get(key) {
    return this.#values.get(key);
  }

  async set(key, value) {
    this.#values.set(key, value);
    for (const listener of this.#listeners.get(key) ?? []) {
      listener(value);
    }
  }

  addChangeListener(key, listener) {
    this.#listeners.set(key, (this.#listeners.get(key) ?? new Set()).add(listener));
  }

  removeChangeListener(key, listener) {
    this.#listeners.get(key)?.delete(listener);
  }
}

/** Studio's layouts, in memory: there is one user, so that namespaces make no difference. */
class Layouts {
  #layouts;

  /** `layouts`: what is in each, by name; the name is its id as well. */
  constructor(layouts) {
    const savedAt = new Date(0).toISOString();
    const made = ([name, data]) => [
      name,
      { id: name, name, permission: "CREATOR_WRITE", baseline: { data, savedAt } },
    ];
    this.#layouts = new Map(Object.entries(layouts).map(made));
  }

  async list() {
    return [...this.#layouts.values()];
  }

  async get(_namespace, id) {
    return this.#layouts.get(id);
  }

  async put(_namespace, layout) {
    this.#layouts.set(layout.id, layout);
    return layout;
  }

  async delete(_namespace, id) {
    this.#layouts.delete(id);
  }

  async importLayouts() {}
}

async function main() {
  const layouts = new Layouts(await (await fetch("layouts.json")).json());
  await window.initI18n();
  await window.waitForFonts();
  const app = window.React.createElement(window.App, {
    appConfiguration: new Settings(),
    dataSources: [new window.FoxgloveWebSocketDataSourceFactory()],
    deepLinks: [window.location.href],
    enableGlobalCss: true,
    extensionLoaders: [],
    layoutStorage: layouts,
  });
  window.ReactDOM.render(app, document.getElementById("root"));
}

main().catch((error) => {
  document.getElementById("root").textContent = `the viewer does not start: ${error}`;
});
