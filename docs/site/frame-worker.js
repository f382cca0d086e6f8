// Search in pages opened from a folder: browsers start no workers there, so a hidden frame runs the script.
(() => {
  if (location.protocol !== "file:") return

  function loaded(page, source) {
    return new Promise((resolve, reject) => {
      const script = page.createElement("script")
      script.src = new URL(source, location.href)
      script.onload = resolve
      script.onerror = () => reject(new Error(`${source} cannot be read`))
      page.body.appendChild(script)
    })
  }

  window.Worker = class extends EventTarget {
    constructor(source) {
      super()
      this.frame = document.createElement("iframe")
      this.frame.hidden = true
      document.body.appendChild(this.frame)
      const inside = this.frame.contentWindow
      inside.document.write("<!doctype html><body></body>")
      inside.document.close()
      inside.postMessage = data => this.hear(data)
      inside.importScripts = async (...sources) => {
        for (const each of sources) await loaded(inside.document, each)
      }
      this.ready = loaded(inside.document, source)
    }

    hear(data) {
      const event = new MessageEvent("message", { data })
      this.dispatchEvent(event)
      if (this.onmessage) this.onmessage(event)
    }

    async postMessage(data) {
      await this.ready
      const inside = this.frame.contentWindow
      inside.dispatchEvent(new inside.MessageEvent("message", { data }))
    }

    terminate() {
      this.frame.remove()
    }
  }
})()
