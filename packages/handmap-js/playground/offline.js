// A service worker: the page works without a network once it was loaded. `pack.py` lists its files and
// names the cache by their content, so that a new page takes the place of an old one.

const LIST = "files.json";

async function cacheAll() {
  const { name, files } = await (await fetch(LIST, { cache: "no-store" })).json();
  const cache = await caches.open(name);
  await cache.addAll(["./", LIST, ...files]);
  for (const other of await caches.keys()) if (other !== name) await caches.delete(other);
}

self.addEventListener("install", (event) => {
  self.skipWaiting();
  event.waitUntil(cacheAll());
});
self.addEventListener("activate", (event) => event.waitUntil(self.clients.claim()));
self.addEventListener("fetch", (event) => {
  if (event.request.method !== "GET") return;
  event.respondWith(caches.match(event.request, { ignoreSearch: true }).then((kept) => kept ?? fetch(event.request)));
});
