// Writes ("write DIR") and reads ("read DIR") the messages of GB/T 35275 and GM/T 0009 with github.com/emmansun/gmsm.
// go mod init peer; go get github.com/emmansun/gmsm@v0.29.7; go run . write DIR
package main

import (
	"crypto/ecdsa"
	"crypto/rand"
	"encoding/hex"
	"encoding/pem"
	"fmt"
	"os"

	"github.com/emmansun/gmsm/pkcs"
	"github.com/emmansun/gmsm/pkcs7"
	"github.com/emmansun/gmsm/sm2"
	"github.com/emmansun/gmsm/smx509"
)

func must(err error) {
	if err != nil {
		panic(err)
	}
}
func read(n string) []byte { b, e := os.ReadFile(n); must(e); return b }

// dir holds key.pem cert.pem; "write" makes messages, "read" opens ours
func main() {
	dir := os.Args[2] + "/"
	kb, _ := pem.Decode(read(dir + "key.pem"))
	ki, err := smx509.ParsePKCS8PrivateKey(kb.Bytes)
	must(err)
	key := ki.(*sm2.PrivateKey)
	cert, err := smx509.ParseCertificatePEM(read(dir + "cert.pem"))
	must(err)
	content := read(dir + "content")
	pub := cert.PublicKey.(*ecdsa.PublicKey)
	if os.Args[1] == "write" {
		out := func(n string, b []byte) { fmt.Println(n, hex.EncodeToString(b)) }
		for _, detached := range []bool{false, true} {
			sd, err := pkcs7.NewSMSignedData(content)
			must(err)
			must(sd.AddSigner(cert, key, pkcs7.SignerInfoConfig{}))
			if detached { sd.Detach() }
			b, err := sd.Finish()
			must(err)
			out(fmt.Sprintf("signed_attributes_detached=%v", detached), b)
			sd, err = pkcs7.NewSMSignedData(content)
			must(err)
			must(sd.SignWithoutAttr(cert, key, pkcs7.SignerInfoConfig{}))
			if detached { sd.Detach() }
			b, err = sd.Finish()
			must(err)
			out(fmt.Sprintf("signed_detached=%v", detached), b)
		}
		b, err := pkcs7.EncryptSM(pkcs.SM4CBC, content, []*smx509.Certificate{cert})
		must(err)
		out("enveloped", b)
		se, err := pkcs7.NewSMSignedAndEnvelopedData(content, pkcs.SM4CBC)
		must(err)
		must(se.AddSigner(cert, key))
		must(se.AddRecipient(cert))
		b, err = se.Finish()
		must(err)
		out("signed_and_enveloped", b)
		other, err := sm2.GenerateKey(rand.Reader)
		must(err)
		b, err = sm2.MarshalEnvelopedPrivateKey(rand.Reader, pub, other)
		must(err)
		out("enveloped_key", b)
		out("enveloped_key_d", other.D.FillBytes(make([]byte, 32)))
		return
	}
	for _, n := range []string{"signed", "signed_attributes", "detached"} {
		p, err := pkcs7.Parse(read(dir + n))
		must(err)
		if n == "detached" { p.Content = content }
		must(p.Verify())
		fmt.Println(n, string(p.Content) == string(content))
	}
	p, err := pkcs7.Parse(read(dir + "enveloped"))
	must(err)
	got, err := p.Decrypt(cert, key)
	must(err)
	fmt.Println("enveloped", string(got) == string(content))
	p, err = pkcs7.Parse(read(dir + "signed_and_enveloped"))
	must(err)
	got, err = p.DecryptAndVerify(cert, key, func() error { return p.Verify() })
	must(err)
	fmt.Println("signed_and_enveloped", string(got) == string(content))
	k2, err := sm2.ParseEnvelopedPrivateKey(key, read(dir+"enveloped_key"))
	must(err)
	fmt.Println("enveloped_key", hex.EncodeToString(k2.D.FillBytes(make([]byte, 32))))
}
